"""Click a pixel to see its gradient for each Gaussian; click a Gaussian to see its gradient from each pixel.

The terms of the renderer's gradient, with v_C = dL/dC at a pixel (``render.composite`` has the derivation):

    dL/dc_k     = w_k v_C
    dL/dalpha_k = T_k (c_k . v_C) - S_k / (1 - alpha_k),   S_k = sum_{j>k} w_j (c_j . v_C)
    dalpha/du   = alpha (A dx + B dy),   dalpha/dv = alpha (B dx + C dy),   dalpha/do = alpha / o
"""

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from markupsafe import Markup
from torch import Tensor

from ...checks import check_name
from ...drawing.page import html_table
from ...drawing.pictures import AnyImage, Picture, side_by_side, to_uint8
from ...optim import dssim_vjp, l1_vjp
from ...render import composite, composite_vjp, tile_intersections
from ...render.constants import ALPHA_MAX
from ...types import Camera, GaussianParams
from ..display import Bundle, ClickImage, LostNotice, with_picture
from .pixel_stack import (
    CELL_STYLE,
    CROSS,
    INK,
    Blend,
    PixelStack,
    Splats,
    blend_at,
    blend_pixel,
    draw_ring,
    enlarged,
    outlines,
    project_splats,
    resize_to_height,
    stack_of,
    swatch,
    with_cross,
)

FIELD_WORK = 150_000
"""Most pairs of pixel and Gaussian that are evaluated; beyond, only every n-th pixel is."""


def blend_vjp(
    splats: Splats, blend: Blend, v_colour: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, "P K"], Float[Tensor, "P K 2"]]:
    """dL/dalpha_k and dL/d(u_k, v_k) of every Gaussian from every pixel, not summed."""
    alpha, T, w = blend.alpha, blend.transmittance[:, :-1], blend.weight
    c_dot_v = v_colour @ splats.rgb[blend.row].T
    wcv = w * c_dot_v
    S = wcv.flip(1).cumsum(1).flip(1) - wcv
    v_alpha = T * c_dot_v - S / (1.0 - alpha)
    v_alpha = torch.where((alpha > 0) & (alpha < ALPHA_MAX), v_alpha, 0.0)  # cut and clamp have slope zero
    A, B, C = splats.projection.conic[blend.row].unbind(-1)
    dx, dy = blend.offset_px.unbind(-1)
    slope = torch.stack([A * dx + B * dy, B * dx + C * dy], -1)
    return v_alpha, (v_alpha * alpha)[..., None] * slope


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelGradient:
    """The gradient from one pixel for the Gaussians of its stack, nearest first. A notebook shows it as a table."""

    stack: PixelStack
    v_colour: Float[Tensor, "3"]
    """dL/dC of the pixel."""
    v_rgb: Float[Tensor, "K 3"]
    v_alpha: Float[Tensor, " K"]
    v_opacity: Float[Tensor, " K"]
    v_uv: Float[Tensor, "K 2"]

    def _repr_html_(self) -> str:
        return pixel_gradient_table(self)


def pixel_gradient(splats: Splats, v_rgb: Float[Tensor, "H W 3"], u: int, v: int) -> PixelGradient:
    """The gradient from pixel (column ``u``, row ``v``) for each Gaussian that made it.

    Args:
        splats: The Gaussians on the screen.
        v_rgb: dL/d of the rendered image.
    """
    blend = blend_pixel(splats, u, v)
    stack = stack_of(splats, blend, u, v)
    v_C = v_rgb[v, u].to(stack.rgb)
    v_alpha, v_uv = blend_vjp(splats, blend, v_C[None])
    return PixelGradient(
        stack=stack, v_colour=v_C, v_rgb=stack.weight[:, None] * v_C, v_alpha=v_alpha[0],
        v_opacity=v_alpha[0] * stack.alpha / splats.projection.opacity[stack.row], v_uv=v_uv[0],
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianGradient:
    """The gradient that one Gaussian receives, pixel by pixel, on a grid of h x w pixels."""

    row: int
    uv: Float[Tensor, "h w 2"]
    """Pixel centres of the grid."""
    stride: int
    """Distance between the grid's pixels; only with 1 the sum is the renderer's gradient."""
    weight: Float[Tensor, "h w"]
    v_alpha: Float[Tensor, "h w"]
    v_uv: Float[Tensor, "h w 2"]


def gaussian_gradient(splats: Splats, v_rgb: Float[Tensor, "H W 3"], row: int) -> GaussianGradient:
    """The gradient for one Gaussian from every pixel under it.

    Args:
        splats: The Gaussians on the screen.
        v_rgb: dL/d of the rendered image.
        row: The Gaussian.

    Raises:
        ValueError: there is no such row, or it is not in the picture.
    """
    p, camera = splats.projection, splats.camera
    if not 0 <= row < len(p.depth_m):
        raise ValueError(f"row must be 0..{len(p.depth_m) - 1}, got {row}")
    low, high = p.uv[row] - p.extent_px[row], p.uv[row] + p.extent_px[row]
    size = low.new_tensor([camera.width, camera.height])
    first = (low - 0.5).ceil().clamp(min=0).minimum(size)
    last = (high - 0.5).floor().minimum(size - 1)
    if not bool(p.visible[row]) or bool((last < first).any()):
        raise ValueError(f"Gaussian {row} is not in the picture")
    crossing = (p.visible & ((p.uv - p.extent_px) < high).all(1) & ((p.uv + p.extent_px) > low).all(1)).sum()
    n_pixels = float((last - first + 1).prod())
    stride = max(1, round((n_pixels * float(crossing) / FIELD_WORK) ** 0.5))
    x = torch.arange(int(first[0]), int(last[0]) + 1, stride, device=low.device) + 0.5
    y = torch.arange(int(first[1]), int(last[1]) + 1, stride, device=low.device) + 0.5
    v, u = torch.meshgrid(y, x, indexing="ij")
    uv = torch.stack([u, v], -1).to(p.uv)
    blend = blend_at(splats, uv.view(-1, 2))
    v_C = v_rgb[v.long(), u.long()].view(-1, 3).to(p.uv)
    v_alpha, v_uv = blend_vjp(splats, blend, v_C)
    mine = (blend.row == row).to(p.uv)  # all zero if no pixel of the grid sees it
    shape = uv.shape[:2]
    return GaussianGradient(
        row=row, uv=uv, stride=stride, weight=(blend.weight @ mine).view(shape), v_alpha=(v_alpha @ mine).view(shape),
        v_uv=torch.einsum("pkc,k->pc", v_uv, mine).view(*shape, 2),
    )  # fmt: skip


def pixel_gradient_table(gradient: PixelGradient, rows: int = 12, unit: float | int = 1.0) -> str:
    """The gradients as an HTML table.

    Args:
        gradient: From ``pixel_gradient``.
        rows: Number of lines: the Gaussians with the largest weights, nearest first.
        unit: Numbers are divided by this: 1 / (number of values) turns an L1 gradient into +1 and -1.
    """
    s = gradient.stack
    heads = ("k", "row", "w", "dL/dα", "descent makes it", "dL/do", "dL/du", "dL/dv", "c now", "dL/dr, dL/dg, dL/db")
    lines = []
    keep = s.weight.argsort(descending=True)[:rows].sort().values.tolist()
    for k in keep:
        a, o = float(gradient.v_alpha[k]) / unit, float(gradient.v_opacity[k]) / unit
        u, v = (gradient.v_uv[k] / unit).tolist()
        wish = "no change" if abs(a) < 1e-9 else ("more opaque" if a < 0 else "less opaque")
        rgb = " ".join(f"{float(x) / unit:+.3f}" for x in gradient.v_rgb[k])
        numbers = (f"{a:+.3f}", wish, f"{o:+.3f}", f"{u:+.3f}", f"{v:+.3f}")
        lines.append((str(k), str(int(s.row[k])), f"{float(s.weight[k]):.3f}", *numbers, swatch(s.rgb[k]), rgb))
    foot = f"… {len(s) - len(keep)} more with smaller weights" if len(keep) < len(s) else ""
    looks = {"name": "gsnb-pixel-gradient", "style": "font-size:12px", "cell_style": CELL_STYLE}
    return html_table(lines, heads=heads, foot=foot, **looks)


MORE, LESS = (26, 127, 55), (198, 40, 40)
"""Green: gradient descent makes the Gaussian more opaque there; red: less."""
_SHOWN = 8


def pixel_gradient_picture(image: AnyImage, splats: Splats, gradient: PixelGradient, *, size: int = 300) -> Picture:
    """The Gaussians with the largest weights at a pixel, ellipses green (descent makes them more opaque) or red (less).

    An arrow points along -(dL/du, dL/dv), where descent moves the centre; the longest has a fixed length.
    """
    import cv2

    s = gradient.stack
    top = s.weight.argsort(descending=True)[:_SHOWN]
    centre = np.array([s.u + 0.5, s.v + 0.5])
    uv = splats.projection.uv[s.row[top]].double().numpy()
    far = np.abs(uv - centre).max(initial=0.0)
    radius = int(min(max(far * 1.15 + 2, 6), 40))
    view, zoom, origin = enlarged(image, (int(centre[0]), int(centre[1])), radius, size)
    push = -gradient.v_uv[top].double().numpy()
    longest = max(float(np.linalg.norm(push, axis=1).max(initial=0.0)), 1e-30)
    for i, ring in reversed(list(enumerate(outlines(splats, s.row[top])))):
        v_alpha = float(gradient.v_alpha[top[i]])
        ink = INK if abs(v_alpha) < 1e-30 else (MORE if v_alpha < 0 else LESS)
        draw_ring(view, (ring - origin) * zoom, ink, 3 if i == 0 else 2)
    for i, at in enumerate(uv):
        start = (at - origin) * zoom
        _arrow(view, start, start + push[i] / longest * 0.16 * size, (255, 255, 255), 5)
        _arrow(view, start, start + push[i] / longest * 0.16 * size, INK, 2)
    x, y = ((np.array([s.u, s.v]) - origin) * zoom).round().astype(int)
    cv2.rectangle(view, (int(x), int(y)), (int(x + zoom), int(y + zoom)), CROSS, 2)
    return view


def gaussian_gradient_picture(
    image: AnyImage, splats: Splats, gradient: GaussianGradient, *, size: int = 300
) -> Picture:
    """The pixels under a Gaussian: green where descent makes it more opaque, red where less; arrows where it moves it.

    Small arrows are -(dL/du, dL/dv) of single pixels, averaged over a grid of at most 11 x 11; the thick one is their
    sum, not to the same scale.
    """
    import cv2

    centre = splats.projection.uv[gradient.row].double().numpy()
    reach = float((gradient.uv - splats.projection.uv[gradient.row]).abs().max()) if gradient.uv.numel() else 4.0
    view, zoom, origin = enlarged(image, (int(centre[0]), int(centre[1])), int(min(max(reach + 2, 5), 60)), size)
    grey = view.mean(2, keepdims=True) * 0.5 + 110
    view = np.repeat(grey, 3, 2).clip(0, 255).astype(np.uint8)
    strongest = max(float(gradient.v_alpha.abs().max()) if gradient.v_alpha.numel() else 0.0, 1e-30)
    half = max(gradient.stride, 1) / 2
    for uv, value in zip(
        gradient.uv.view(-1, 2).tolist(), (gradient.v_alpha / strongest).flatten().tolist(), strict=True
    ):
        a, b = (
            ((np.array(uv) - half - origin) * zoom).round().astype(int),
            ((np.array(uv) + half - origin) * zoom).round().astype(int),
        )
        patch = view[max(a[1], 0) : max(b[1], 0), max(a[0], 0) : max(b[0], 0)]
        if patch.size:
            mix = min(abs(value), 1.0) ** 0.5 * 0.85
            patch[:] = (patch * (1 - mix) + np.array(MORE if value < 0 else LESS) * mix).astype(np.uint8)
    draw_ring(view, (outlines(splats, torch.tensor([gradient.row]))[0] - origin) * zoom, (255, 255, 255), 2)
    starts, pushes = _coarse(gradient)
    longest = max(float(np.linalg.norm(pushes, axis=1).max(initial=0.0)), 1e-30)
    for at, push in zip(starts, pushes, strict=True):
        start = (at - origin) * zoom
        _arrow(view, start, start + push / longest * 0.075 * size, INK, 1)
    total = -gradient.v_uv.sum((0, 1)).double().numpy()
    length = float(np.linalg.norm(total))
    if length > 1e-30:
        start = (centre - origin) * zoom
        for ink, wide in (((255, 255, 255), 8), ((40, 60, 200), 4)):
            _arrow(view, start, start + total / length * 0.2 * size, ink, wide)
    cv2.circle(view, tuple(int(c) for c in ((centre - origin) * zoom).round()), 4, (255, 255, 255), -1, cv2.LINE_AA)
    return view


def _coarse(gradient: GaussianGradient) -> tuple[np.ndarray, np.ndarray]:
    """Centres and mean -(dL/du, dL/dv) of at most 11 x 11 blocks of pixels."""
    h, w = gradient.weight.shape
    step = max(1, -(-max(h, w) // 11))
    at, push = gradient.uv.double().numpy(), -gradient.v_uv.double().numpy()
    blocks = [(y, x) for y in range(0, h, step) for x in range(0, w, step)]
    mean = [[a[y : y + step, x : x + step].mean((0, 1)) for y, x in blocks] for a in (at, push)]
    return np.array(mean[0]).reshape(-1, 2), np.array(mean[1]).reshape(-1, 2)


def _arrow(view: np.ndarray, start: np.ndarray, end: np.ndarray, ink: tuple[int, ...], wide: int) -> None:
    import cv2

    a, b = (tuple(int(c) for c in p.round().clip(-10_000, 10_000)) for p in (start, end))
    if a != b:
        cv2.arrowedLine(view, a, b, ink, wide, cv2.LINE_AA, tipLength=0.35)


PICKS = ("pixel", "Gaussian")
"""What a click can choose."""
PICTURE_PX = 222
"""Height of the pictures, pixels."""
LABELS = ("rendered", "target", "direction of descent")


class GradientMicroscope:
    """The gradient of L1 (and D-SSIM) of one image, split into the terms of single pixels and Gaussians.

    Click the rendered picture. With "pixel", every Gaussian of the pixel's stack shows its dL/dalpha and an arrow
    along -dL/d(u, v). With "Gaussian", the one with the largest weight there shows the term of each pixel and their
    sum, which is the renderer's gradient. From Python: ``look_at(u, v)`` and ``pick``.

    Args:
        params, camera, T_WC: The map, and the camera and pose that it is seen from.
        target: The photograph. [H, W, 3]
        ssim_weight: L = (1 - s) L1 + s D-SSIM.
        pixel: Where to look first; the middle by default. (column, row)
    """

    def __init__(
        self,
        params: GaussianParams,
        camera: Camera,
        T_WC: Float[Tensor, "4 4"],
        target: Float[Tensor, "H W 3"],
        *,
        ssim_weight: float | int = 0.0,
        pixel: tuple[int, int] | None = None,
    ):
        self.target, self._ssim_weight = target, float(ssim_weight)
        self._lock = threading.RLock()  # callbacks may come from another thread than the cells
        self._pick = PICKS[0]
        self._u, self._v = pixel or (camera.width // 2, camera.height // 2)
        self._read(params, camera, T_WC)
        self._of_pixel: PixelGradient = pixel_gradient(self.splats, self.v_rgb, self._u, self._v)
        self._build()
        self._redraw()

    @property
    def pick(self) -> str:
        """What a click chooses, "pixel" or "Gaussian"."""
        return self._pick

    @pick.setter
    def pick(self, pick: str) -> None:
        check_name("pick", pick, PICKS)
        with self._lock:
            self._pick = pick
            self.choice.value = pick
            self._redraw()

    @property
    def row(self) -> int | None:
        """The Gaussian with the largest weight at the chosen pixel, ``None`` where there is none."""
        stack = self.of_pixel.stack
        return int(stack.row[stack.weight.argmax()]) if len(stack) else None

    @property
    def of_pixel(self) -> PixelGradient:
        """The gradient from the chosen pixel for each of its Gaussians."""
        return self._of_pixel

    @property
    def of_gaussian(self) -> GaussianGradient | None:
        """The gradient of the chosen Gaussian from each pixel; ``None`` where no Gaussian is chosen."""
        return None if self.row is None else gaussian_gradient(self.splats, self.v_rgb, self.row)

    def look_at(self, u: int, v: int) -> "GradientMicroscope":
        """Choose the pixel in column ``u`` and row ``v``."""
        with self._lock:
            self._choose(u, v)
            self.clicks.pixel = (u, v)
        return self

    def lens(self) -> Picture:
        """The picture with the arrows."""
        field = self.of_gaussian if self._pick == "Gaussian" else None
        if field is not None:
            return gaussian_gradient_picture(self.image, self.splats, field, size=PICTURE_PX)
        return pixel_gradient_picture(self.image, self.splats, self.of_pixel, size=PICTURE_PX)

    def table(self) -> str:
        """The numbers, in units of 1 / (number of values in the image), as HTML."""
        if self._pick == "Gaussian" and self.row is not None:
            return self._gaussian_table(self.row)
        return pixel_gradient_table(self.of_pixel, unit=1 / self.target.numel())

    def picture(self) -> Picture:
        """The three pictures in a row, as a stored notebook shows them."""
        pair = [with_cross(self.image, self._u, self._v, PICTURE_PX), resize_to_height(self.target, PICTURE_PX)]
        return side_by_side([*pair, self.lens()], LABELS)

    def _repr_mimebundle_(self, **kwargs: Any) -> Bundle:
        words = f"GradientMicroscope(pixel ({self._u}, {self._v}), a click picks a {self._pick})"
        return with_picture(
            self.widget._repr_mimebundle_(**kwargs), self.picture(), words, alt=f"{self.clicks.alt}; {self.arrows.alt}"
        )

    def _read(self, params: GaussianParams, camera: Camera, T_WC: Tensor) -> None:
        """Render, and compute the gradient with respect to the projected Gaussians."""
        with torch.no_grad():
            self.splats = project_splats(params, camera, T_WC)
            p = self.splats.projection
            tiles = tile_intersections(p, camera)
            out = composite(p.uv, p.conic, p.opacity, self.splats.rgb, p.depth_m, tiles, camera, with_indices=False)
            s = self._ssim_weight
            self.v_rgb = l1_vjp(out.rgb, self.target, 1.0 - s)
            if s > 0:
                self.v_rgb = self.v_rgb + dssim_vjp(out.rgb, self.target, s)[1]
            self.image = to_uint8(out.rgb)
            self.total = composite_vjp(out.saved, self.v_rgb)

    def _gaussian_table(self, row: int) -> str:
        unit, g = 1 / self.target.numel(), self.total
        numbers = {
            "dL/du": g.uv[row, 0], "dL/dv": g.uv[row, 1], "dL/do": g.opacity[row],
            "dL/dr": g.rgb[row, 0], "dL/dg": g.rgb[row, 1], "dL/db": g.rgb[row, 2],
        }  # fmt: skip
        bold = Markup("<b>{}</b>")
        first = (Markup("Gaussian ") + bold.format(row), *map(bold.format, numbers))
        second = ("sum over all pixels", *(f"{float(x) / unit:+.2f}" for x in numbers.values()))
        return html_table((first, second), style="font-size:12px", cell_style=CELL_STYLE)

    def _build(self) -> None:
        import ipywidgets as w

        camera = self.splats.camera
        wide = round(camera.width * PICTURE_PX / camera.height)
        self.clicks = ClickImage(camera.width, camera.height, width=wide, format="png", alt="the rendered map; click")
        self.clicks.add_class("gsnb-gradient-image")
        self.clicks.pixel = (self._u, self._v)
        self.clicks.observe(self._clicked, "pixel")
        photo = ClickImage(camera.width, camera.height, width=wide, alt="the photograph that is the target", touch="")
        photo.show(self.target)
        self.arrows = ClickImage(PICTURE_PX, PICTURE_PX, width=PICTURE_PX, format="png", touch="")
        self.arrows.add_class("gsnb-gradient-arrows")
        self.choice = w.ToggleButtons(options=list(PICKS), description="a click picks", style={"button_width": "90px"})
        self.choice.observe(self._chosen, "value")
        self.numbers = w.HTML()
        self.numbers.add_class("gsnb-gradient-table")
        panels = [
            w.VBox([w.HTML(label), image])
            for label, image in zip(LABELS, (self.clicks, photo, self.arrows), strict=True)
        ]
        row = w.Layout(flex_flow="row wrap", grid_gap="8px")
        self.widget = w.VBox([self.choice, w.HBox(panels, layout=row), self.numbers, LostNotice()])
        self.widget.add_class("gsnb-gradient")

    def _clicked(self, _change: Any) -> None:
        with self._lock:
            u, v = self.clicks.pixel  # the newest, which may be newer than the change
            if (u, v) != (self._u, self._v):
                self._choose(u, v)

    def _choose(self, u: int, v: int) -> None:
        self._of_pixel = pixel_gradient(self.splats, self.v_rgb, u, v)
        self._u, self._v = u, v
        self._redraw()

    def _chosen(self, change: Any) -> None:
        if change["new"] != self._pick:
            self.pick = change["new"]

    def _redraw(self) -> None:
        self.clicks.show(with_cross(self.image, self._u, self._v, PICTURE_PX))
        self.arrows.show(self.lens())
        what = f"Gaussian {self.row}" if self._pick == "Gaussian" else f"the Gaussians of pixel ({self._u}, {self._v})"
        self.arrows.alt = f"direction of descent for {what}, as arrows; the table has the numbers"
        unit = f"numbers are multiples of 1/{self.target.numel():,}: L1 gives ±1 per pixel and channel"
        self.numbers.value = f"pixel ({self._u}, {self._v}); {unit}<br>{self.table()}"
