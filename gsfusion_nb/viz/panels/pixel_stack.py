"""Which Gaussians made a pixel: the blending of a few pixels, one Gaussian at a time, as numbers and as drawings.

The renderer does not record which Gaussians contributed to a pixel. Here every Gaussian is evaluated at the chosen
pixels, with the formulas of ``render.composite`` but without the lists of the tiles: a Gaussian that is missing in a
list is seen here.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int
from markupsafe import Markup
from torch import Tensor

from ...drawing.page import html_table
from ...drawing.pictures import CARD, CARD_INK, AnyImage, Picture, to_uint8
from ...geometry.spherical_harmonics import sh_to_rgb
from ...render import Projection, blend_rows, project_gaussians
from ...types import Camera, GaussianParams

TABLE_ROWS = 14
"""Rows of the table; the rest is summed up in one line."""
CELL_STYLE = "text-align:right;padding:1px 8px;line-height:1.35"
"""CSS of the cells of the microscopes' tables."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Splats:
    """A Gaussian map as a camera sees it, before blending: ellipses and colours."""

    projection: Projection
    rgb: Float[Tensor, "N 3"]
    camera: Camera


def project_splats(params: GaussianParams, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> Splats:
    """The first two stages of ``render``: EWA projection and the colour seen from this camera."""
    T_WC = T_WC.to(params.xyz_W)
    return Splats(
        projection=project_gaussians(params, camera, T_WC),
        rgb=sh_to_rgb(params.sh, params.xyz_W, T_WC[:3, 3]),
        camera=camera,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Blend:
    """The terms of ``C = sum_k w_k c_k`` at P pixels. Column k is one Gaussian, nearest first."""

    row: Int[Tensor, " K"]
    """Row in the map."""
    offset_px: Float[Tensor, "P K 2"]
    """(dx, dy) = pixel centre - (u, v)."""
    alpha: Float[Tensor, "P K"]
    """Zero where below 1/255 and where blending had already stopped."""
    transmittance: Float[Tensor, "P K+1"]
    """T_k in front of each; the last column is the transmittance behind all."""

    @property
    def weight(self) -> Float[Tensor, "P K"]:
        """w_k = alpha_k T_k."""
        return self.alpha * self.transmittance[:, :-1]


def blend_at(splats: Splats, uv: Float[Tensor, "P 2"]) -> Blend:
    """Blend every Gaussian that reaches one of the pixel centres ``uv`` (Kerbl et al. 2023, eq. 2-3).

    Args:
        splats: Ellipses and colours.
        uv: Pixel centres (i + 0.5, j + 0.5), pixels. [P, 2]

    Differentiable: no.
    """
    p = splats.projection
    low, high = uv.amin(0) - p.extent_px, uv.amax(0) + p.extent_px
    near = p.visible & (p.uv >= low).all(1) & (p.uv <= high).all(1)
    row = near.nonzero().squeeze(1)
    row = row[p.depth_m[row].argsort(stable=True)]
    x, y = uv.floor().long().unbind(-1)
    alpha, _, weight = blend_rows(p.uv[row], p.conic[row], p.opacity[row], x, y)
    alpha = torch.where(weight > 0, alpha, 0.0).T
    one = alpha.new_ones(len(uv), 1)
    T = torch.cat([one, (1.0 - alpha).cumprod(1)], dim=1)
    used = (alpha > 0).any(0)
    return Blend(
        row=row[used],
        offset_px=(uv[:, None] - p.uv[row])[:, used],
        alpha=alpha[:, used],
        transmittance=torch.cat([T[:, :-1][:, used], T[:, -1:]], dim=1),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelStack:
    """The Gaussians that made one pixel, nearest first, K of them. A notebook shows it as a table."""

    u: int
    """Pixel column."""
    v: int
    """Pixel row."""
    row: Int[Tensor, " K"]
    depth_m: Float[Tensor, " K"]
    alpha: Float[Tensor, " K"]
    transmittance: Float[Tensor, " K"]
    """T_k, the light left in front of each."""
    weight: Float[Tensor, " K"]
    """w_k = alpha_k T_k."""
    rgb: Float[Tensor, "K 3"]
    """c_k."""
    light_left: float
    """T behind all of them: the weight of the black background."""

    def __len__(self) -> int:
        return self.row.shape[0]

    @property
    def contribution(self) -> Float[Tensor, "K 3"]:
        """w_k c_k: what each adds to the pixel."""
        return self.weight[:, None] * self.rgb

    @property
    def colour(self) -> Float[Tensor, "3"]:
        """Their sum: the colour of the pixel."""
        return self.contribution.sum(0)

    def __repr__(self) -> str:
        r, g, b = self.colour.tolist()
        return f"PixelStack(pixel ({self.u}, {self.v}), {len(self)} Gaussians, colour {r:.3f} {g:.3f} {b:.3f})"

    def _repr_html_(self) -> str:
        return stack_table(self)


def pixel_stack(splats: Splats, u: int, v: int) -> PixelStack:
    """The stack of Gaussians behind pixel (column ``u``, row ``v``).

    Raises:
        ValueError: the pixel is not in the picture.
    """
    return stack_of(splats, blend_pixel(splats, u, v), u, v)


def blend_pixel(splats: Splats, u: int, v: int) -> Blend:
    """``blend_at`` the centre of one pixel.

    Raises:
        ValueError: the pixel is not in the picture.
    """
    check_pixel(splats.camera, u, v)
    return blend_at(splats, splats.projection.uv.new_tensor([[u + 0.5, v + 0.5]]))


def stack_of(splats: Splats, blend: Blend, u: int, v: int) -> PixelStack:
    """The stack of pixel (u, v) from its ``blend_pixel``."""
    return PixelStack(
        u=u, v=v, row=blend.row, depth_m=splats.projection.depth_m[blend.row], alpha=blend.alpha[0],
        transmittance=blend.transmittance[0, :-1], weight=blend.weight[0], rgb=splats.rgb[blend.row],
        light_left=float(blend.transmittance[0, -1]),
    )  # fmt: skip


def check_pixel(camera: Camera, u: int, v: int) -> None:
    """Raise ``ValueError`` unless the picture has pixel (u, v)."""
    if not (0 <= u < camera.width and 0 <= v < camera.height):
        raise ValueError(
            f"pixel ({u}, {v}) is outside the picture: columns 0..{camera.width - 1}, rows 0..{camera.height - 1}"
        )


def stack_table(stack: PixelStack, rows: int = TABLE_ROWS) -> str:
    """The stack as an HTML table: row, depth, alpha, T, weight, colour, contribution, and the sum below."""
    index = Markup("{}<sub>k</sub>")
    heads = (
        "k",
        "row",
        "depth m",
        index.format("α"),
        index.format("T"),
        index.format("w") + " = α T",
        index.format("c"),
    )
    shown = min(len(stack), rows)
    lines: list[tuple[str, ...]] = []
    for k in range(shown):
        numbers = (f"{x[k]:.3f}" for x in (stack.depth_m, stack.alpha, stack.transmittance, stack.weight))
        lines.append((str(k), str(int(stack.row[k])), *numbers, swatch(stack.rgb[k]), rgb_text(stack.contribution[k])))
    if shown < len(stack):
        weight, contribution = stack.weight[shown:].sum(), stack.contribution[shown:].sum(0)
        more = f"… {len(stack) - shown} more"
        lines.append(("", more, "", "", "", f"{weight:.3f}", "", rgb_text(contribution)))
    total = (
        "", "sum", "", "", f"left {stack.light_left:.3f}", f"{stack.weight.sum():.3f}",
        swatch(stack.colour), rgb_text(stack.colour),
    )  # fmt: skip
    lines.append(tuple(Markup("<b>{}</b>").format(x) for x in total))
    return html_table(lines, heads=(*heads, "w c"), name="gsnb-stack", style="font-size:12px", cell_style=CELL_STYLE)


def swatch(rgb: Float[Tensor, "3"]) -> Markup:
    """A small square of a colour, as HTML."""
    r, g, b = (round(255 * min(max(float(x), 0.0), 1.0)) for x in rgb)
    style = f"display:inline-block;width:26px;height:12px;border:1px solid #8888;background:rgb({r},{g},{b})"
    return Markup('<span style="{}"></span>').format(style)


def rgb_text(rgb: Tensor) -> str:
    """A colour as three numbers."""
    return " ".join(f"{float(x):.3f}" for x in rgb)


INK, FAINT, LIGHT = (28, 36, 48), (84, 92, 104), (229, 98, 115)
"""Colour of lines in pictures, of grid lines on the card, and of the curve of the transmittance."""
CROSS = (255, 210, 0)
"""Colour of the mark at the chosen pixel."""


def stack_picture(stack: PixelStack, *, width: int = 420, height: int = 240, scale: int = 2) -> Picture:
    """One bar per Gaussian, nearest at the left, and below them the colour as it builds up.

    The pale bar is alpha, the full one the weight, in the Gaussian's colour; the red steps are the transmittance. The
    strip at the bottom is the sum of w c so far: its right end is the colour of the pixel.

    Args:
        stack: From ``pixel_stack``.
        width, height: Size on screen, pixels.
        scale: Picture pixels per screen pixel.
    """
    import cv2

    s = scale
    image, (left, right, top, bottom) = empty_graph(width, height, s, left_px=40, below_px=66)
    strip = slice((height - 40) * s, (height - 24) * s)
    write(image, "red: light left T   pale: alpha   full: weight w = alpha T", left, 14 * s, s, ink=CARD_INK)
    write(image, "sum", 10 * s, strip.stop - 4 * s, s, ink=CARD_INK)
    caption = "nearest Gaussian first, to the farthest; below: the colour summed up so far"
    write(image, caption, left, (height - 8) * s, s, ink=CARD_INK)
    edges = np.linspace(left, right, max(len(stack), 1) + 1).round().astype(int)
    _bars(image, stack, edges, (top, bottom), s)
    colours = to_uint8(stack.contribution.cumsum(0).clamp(0, 1)[None])[0]
    for k, colour in enumerate(colours):
        image[strip, edges[k] : edges[k + 1]] = colour
    T = np.array([*stack.transmittance.tolist(), stack.light_left])
    y = (bottom + T * (top - bottom)).round().astype(int)
    steps = list(zip(edges[: len(T)], y, strict=True))
    corners = [steps[0], *(c for a, b in pairwise(steps) for c in ((b[0], a[1]), b)), (right, y[-1])]
    cv2.polylines(image, [np.array(corners, np.int32)], False, LIGHT, s, cv2.LINE_AA)
    return image


def empty_graph(
    width: int, height: int, scale: int, *, left_px: int, below_px: int
) -> tuple[Picture, tuple[int, int, int, int]]:
    """A card with lines at 0, 0.5 and 1, and where they are: left, right, top (1) and bottom (0), picture pixels.

    Args:
        width, height: Size on screen, pixels.
        scale: Picture pixels per screen pixel.
        left_px, below_px: Room at the left of the lines and below them, screen pixels.
    """
    import cv2

    s = scale
    image = np.full((height * s, width * s, 3), CARD, np.uint8)
    left, right, top, bottom = left_px * s, (width - 12) * s, 24 * s, (height - below_px) * s
    for value in (0.0, 0.5, 1.0):
        y = round(bottom + value * (top - bottom))
        cv2.line(image, (left, y), (right, y), FAINT, s)
        write(image, f"{value:g}", 10 * s, y + 4 * s, s, ink=CARD_INK)
    return image, (left, right, top, bottom)


def _bars(image: Picture, stack: PixelStack, edges: np.ndarray, span: tuple[int, int], gap: int) -> None:
    """Alpha and weight of each Gaussian as bars between ``edges``, in place."""
    import cv2

    top, bottom = span
    full = to_uint8(stack.rgb[None])[0].astype(float)
    for k, colour in enumerate(full):
        x0, x1 = int(edges[k]), max(int(edges[k + 1]) - gap, int(edges[k]) + 1)
        for value, fill in ((stack.alpha[k], 0.35 * colour + 0.65 * np.array(CARD)), (stack.weight[k], colour)):
            y = round(bottom + float(value) * (top - bottom))
            cv2.rectangle(image, (x0, y), (x1, bottom), tuple(int(c) for c in fill), -1)
            cv2.rectangle(image, (x0, y), (x1, bottom), (150, 156, 166), 1)


def lens_picture(
    image: AnyImage,
    splats: Splats,
    pixel: tuple[int, int],
    rows: Int[Tensor, " K"],
    *,
    radius_px: int = 12,
    size: int = 300,
) -> Picture:
    """The neighbourhood of a pixel, enlarged without smoothing, with the ellipses of some Gaussians.

    An ellipse is where its Gaussian has fallen to exp(-1/2): one standard deviation.

    Args:
        image: The rendered picture. [H, W, 3]
        splats: What it was rendered from.
        pixel: In the middle, framed. (column, row)
        rows: Gaussians to outline, the most important first, which gets a thicker line.
        radius_px: Pixels of the image to each side.
        size: Edge of the result, pixels.
    """
    import cv2

    view, zoom, corner = enlarged(image, pixel, radius_px, size)
    for i, outline in reversed(list(enumerate(outlines(splats, rows)))):
        draw_ring(view, (outline - corner) * zoom, INK, 1 if i else 2)
    x = y = round(radius_px * zoom)
    cv2.rectangle(view, (x, y), (x + round(zoom), y + round(zoom)), CROSS, 2)
    return view


def enlarged(
    image: AnyImage, pixel: tuple[int, int], radius_px: int, size: int
) -> tuple[Picture, float, Float[np.ndarray, "2"]]:
    """A square around a pixel, enlarged without smoothing, light grey beyond the border of the image.

    Returns:
        The picture, size x size; screen pixels for each pixel; and the pixel at its upper left corner.
    """
    import cv2

    picture, n = to_uint8(image), 2 * radius_px + 1
    (H, W), (u0, v0) = picture.shape[:2], (pixel[0] - radius_px, pixel[1] - radius_px)
    crop = np.full((n, n, 3), 236, np.uint8)
    a, b, c, d = max(v0, 0), min(v0 + n, H), max(u0, 0), min(u0 + n, W)
    if a < b and c < d:
        crop[a - v0 : b - v0, c - u0 : d - u0] = picture[a:b, c:d]
    view = np.asarray(cv2.resize(crop, (size, size), interpolation=cv2.INTER_NEAREST), np.uint8)
    return np.ascontiguousarray(view), size / n, np.array([u0, v0], np.float64)


def draw_ring(view: Picture, points: np.ndarray, ink: tuple[int, ...], wide: int) -> None:
    """Draw a closed line with a white seam, in place; ``points`` in pixels of the view."""
    import cv2

    fixed = (points * 16).round().clip(-1e6, 1e6).astype(np.int32)
    cv2.polylines(view, [fixed], True, (255, 255, 255), wide + 2, cv2.LINE_AA, shift=4)
    cv2.polylines(view, [fixed], True, ink, wide, cv2.LINE_AA, shift=4)


def outlines(splats: Splats, rows: Int[Tensor, " K"], points: int = 48) -> Float[np.ndarray, "K points 2"]:
    """The one-standard-deviation ellipses of some rows as polygons, pixels."""
    return ellipse_outlines(splats.projection.uv[rows], splats.projection.conic[rows], points)


def ellipse_outlines(
    uv: Float[Tensor, "K 2"], conic: Float[Tensor, "K 3"], points: int = 48
) -> Float[np.ndarray, "K points 2"]:
    """Ellipses of one standard deviation as polygons, pixels: u + L (cos t, sin t) with L L^T = cov = conic^-1."""
    A, B, C = conic.double().unbind(-1)
    det = A * C - B * B
    cov_uu, cov_uv, cov_vv = C / det, -B / det, A / det
    l11 = cov_uu.sqrt()
    l21 = cov_uv / l11
    l22 = (cov_vv - l21 * l21).clamp_min(0).sqrt()
    t = torch.linspace(0, 2 * torch.pi, points + 1, dtype=torch.float64)[:-1]
    cos, sin = t.cos(), t.sin()
    ring = torch.stack([l11[:, None] * cos, l21[:, None] * cos + l22[:, None] * sin], -1)
    return (uv.double()[:, None] + ring).numpy()


def with_cross(image: AnyImage, u: int, v: int, height: int) -> Picture:
    """The picture resized to ``height`` pixels, with a small cross around pixel (u, v)."""
    zoom = height / image.shape[0]
    return draw_cross(resize_to_height(image, height), ((u + 0.5) * zoom, (v + 0.5) * zoom))


def draw_cross(picture: Picture, at: tuple[float, float]) -> Picture:
    """A copy of the picture with a small cross around a point (u, v), pixels, open in the middle."""
    import cv2

    image, (x, y) = picture.copy(), (round(at[0] - 0.5), round(at[1] - 0.5))
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        inner, outer = ((x + r * dx, y + r * dy) for r in (4, 12))
        cv2.line(image, inner, outer, (0, 0, 0), 4)
        cv2.line(image, inner, outer, CROSS, 2)
    return image


def resize_to_height(image: AnyImage, height: int) -> Picture:
    """The picture at another height, pixels; enlarged pixels stay sharp squares."""
    import cv2

    picture = to_uint8(image)
    zoom = height / picture.shape[0]
    how = cv2.INTER_AREA if zoom < 1 else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(picture, (round(picture.shape[1] * zoom), height), interpolation=how), np.uint8)


def write(
    image: Picture, words: str, x: int, y: int, scale: int, size: float = 0.36, ink: tuple[int, ...] = INK
) -> None:
    """Write small text into a drawing, in place; text too long for it is written smaller."""
    import cv2

    font = cv2.FONT_HERSHEY_SIMPLEX
    (wide, _), _ = cv2.getTextSize(words, font, size * scale, scale)
    size *= min(1.0, (image.shape[1] - x - 4) / max(wide, 1))
    cv2.putText(image, words, (x, y), font, size * scale, ink, max(1, scale // 2), cv2.LINE_AA)


def ellipse_picture(splats: Splats, height: int) -> Picture:
    """The ellipses of all Gaussians of a map in their own colours on dark grey, farthest first.

    Args:
        splats: The Gaussians on the screen.
        height: Of the picture, pixels.
    """
    import cv2

    p, camera = splats.projection, splats.camera
    zoom = height / camera.height
    view = np.full((height, round(camera.width * zoom), 3), 32, np.uint8)
    rows = p.visible.nonzero().squeeze(1)
    rows = rows[p.depth_m[rows].argsort(descending=True)]
    rings = (outlines(splats, rows, 20) * zoom * 16).round().clip(-1e6, 1e6).astype(np.int32)
    inks = to_uint8(splats.rgb[rows][None])[0].tolist()
    for ring, ink in zip(rings, inks, strict=True):
        cv2.polylines(view, [ring], True, ink, 1, cv2.LINE_AA, shift=4)
    return view
