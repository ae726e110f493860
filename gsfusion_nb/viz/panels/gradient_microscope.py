"""Click a pixel to see its gradient for each Gaussian; click a Gaussian to see its gradient from
each pixel. The terms are in ``pixel_gradients``."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.curves import figure_picture, image_figure, rgb_of
from ...drawing.pictures import AnyImage, Picture, side_by_side, to_uint8
from ...optim import l1_vjp
from ...render import composite, composite_vjp, tile_intersections
from ...types import Camera, GaussianParams
from .ellipses import draw_ellipses, lens_figure, resize_to_height, with_cross
from .panel import Choice, Drawn, Panel
from .pixel_blend import Splats, project_splats
from .pixel_gradients import GaussianGradient, PixelGradient, gaussian_gradient, pixel_gradient
from .pixel_stack import INK, TABLE_ROWS, numbers_table, swatch
from .touch import pixel_sliders, touched_pixel

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def pixel_gradient_table(gradient: PixelGradient, unit: float | int) -> str:
    """The gradients of the Gaussians with the largest weights, nearest first, as an HTML table.

    Args:
        gradient: From ``pixel_gradient``.
        unit: Numbers are divided by this: 1 / (number of values) turns an L1 gradient into +1 and
            -1.
    """
    s = gradient.stack
    heads = (
        "k",
        "row",
        "w",
        "dL/dα",
        "descent makes it",
        "dL/do",
        "dL/du",
        "dL/dv",
        "c now",
        "dL/dr, dL/dg, dL/db",
    )
    lines = []
    for k in s.weight.argsort(descending=True)[:TABLE_ROWS].sort().values.tolist():
        a, o, u, v = (
            float(x) / unit for x in (gradient.v_alpha[k], gradient.v_opacity[k], *gradient.v_uv[k])
        )
        wish = "no change" if abs(a) < 1e-9 else ("more opaque" if a < 0 else "less opaque")
        rgb = " ".join(f"{x:+.3f}" for x in (gradient.v_rgb[k] / unit).tolist())
        numbers = (f"{a:+.3f}", wish, f"{o:+.3f}", f"{u:+.3f}", f"{v:+.3f}")
        lines.append(
            (
                str(k),
                str(int(s.row[k])),
                f"{float(s.weight[k]):.3f}",
                *numbers,
                swatch(s.rgb[k]),
                rgb,
            )
        )
    return numbers_table(heads, lines, n=len(s))


MORE = "#3d85c6"
LESS = "#d55e00"
"""Blue: gradient descent makes the Gaussian more opaque there; orange: less."""
_SHOWN = 8


def pixel_gradient_picture(
    image: AnyImage, splats: Splats, gradient: PixelGradient, *, size: int = 300
) -> Picture:
    """The Gaussians with the largest weights at a pixel, ellipses blue (descent makes them more
    opaque) or orange (less).

    An arrow points along -(dL/du, dL/dv), where descent moves the centre; the longest has a fixed
    length.
    """
    s = gradient.stack
    top = s.weight.argsort(descending=True)[:_SHOWN]
    uv = splats.projection.uv[s.row[top]].double().numpy()
    reach_px = np.abs(uv - (s.u + 0.5, s.v + 0.5)).max(initial=0.0)
    figure, axes = lens_figure(
        image,
        (s.u, s.v),
        int(min(max(reach_px * 1.15 + 2, 6), 40)),
        size,
    )
    inks = [INK if x == 0 else MORE if x < 0 else LESS for x in gradient.v_alpha[top].tolist()]
    draw_ellipses(axes, splats, s.row[top], inks)
    _arrows(axes, uv, -gradient.v_uv[top].double().numpy(), 0.16)
    return figure_picture(figure)


def gaussian_gradient_picture(
    image: AnyImage, splats: Splats, gradient: GaussianGradient, *, size: int = 300
) -> Picture:
    """The pixels under a Gaussian: blue where descent makes it more opaque, orange where less;
    arrows where it moves it.

    Small arrows are -(dL/du, dL/dv) of single pixels, averaged over a grid of at most 11 x 11; the
    thick one is their sum, not to the same scale.
    """
    centre = splats.projection.uv[gradient.row].double().numpy()
    uv = gradient.uv.double().numpy()
    push = -gradient.v_uv.double().numpy()
    reach = min(
        max(float(np.abs(uv - centre).max(initial=4.0)) + 2, 5),
        60,
    )
    grey = to_uint8(image).mean(2, keepdims=True) * 0.5 + 110
    window = (centre[0] - reach, centre[0] + reach, centre[1] - reach, centre[1] + reach)
    figure, axes = image_figure(
        grey.repeat(3, 2).clip(0, 255).astype(np.uint8),
        (size, size),
        window,
    )
    strength = (gradient.v_alpha / gradient.v_alpha.abs().max().clamp_min(1e-30)).numpy()
    colour = (
        np.where(
            strength[..., None] < 0,
            rgb_of(MORE),
            rgb_of(LESS),
        )
        / 255
    )
    half = gradient.stride / 2
    extent = (uv[0, 0, 0] - half, uv[-1, -1, 0] + half, uv[-1, -1, 1] + half, uv[0, 0, 1] - half)
    shade = np.concatenate([colour, 0.85 * np.abs(strength)[..., None] ** 0.5], 2)
    axes.imshow(shade, extent=extent, interpolation="nearest", aspect="auto")
    axes.set(xlim=window[:2], ylim=window[:1:-1])
    draw_ellipses(axes, splats, torch.tensor([gradient.row]), "white")
    step = -(-max(uv.shape[:2]) // 11)
    blocks = [
        np.s_[y : y + step, x : x + step]
        for y in range(0, len(uv), step)
        for x in range(0, uv.shape[1], step)
    ]
    starts, pushes = (np.array([a[block].mean((0, 1)) for block in blocks]) for a in (uv, push))
    _arrows(axes, starts, pushes, 0.075, width=0.006)
    _arrows(
        axes,
        centre[None],
        push.sum((0, 1))[None],
        0.2,
        color="#283cc8",
        width=0.016,
    )
    return figure_picture(figure)


def _arrows(
    axes: "Axes",
    start: np.ndarray,
    push: np.ndarray,
    longest: float,
    **how: Any,
) -> None:
    """Arrows in the image; the longest has this share of the picture's width."""
    scale = (
        max(
            float(np.linalg.norm(push, axis=1).max(initial=0.0)),
            1e-30,
        )
        / longest
    )
    looks = {"color": INK, "width": 0.009, "edgecolor": "white", "linewidth": 0.6, **how}
    axes.quiver(
        *start.T,
        *push.T,
        angles="xy",
        scale_units="width",
        scale=scale,
        zorder=4,
        **looks,
    )


PICKS = ("pixel", "Gaussian")
"""What a click can choose."""
PICTURE_PX = 222
"""Height of the pictures, pixels."""


class GradientMicroscope(Panel):
    """The gradient of L1 of one image, split into the terms of single pixels and Gaussians.

    Click the rendered picture. With "pixel", every Gaussian of the pixel's stack shows its
    dL/dalpha and an arrow along -dL/d(u, v). With "Gaussian", the one with the largest weight there
    shows the term of each pixel and their sum, which is the renderer's gradient. From Python:
    ``set(u=u, v=v, pick="Gaussian")``.

    Args:
        params, camera, T_WC: The map, and the camera and pose that it is seen from.
        target: The photograph. [H, W, 3]
        pixel: Where to look first; the middle by default. (column, row)
    """

    def __init__(
        self,
        params: GaussianParams,
        camera: Camera,
        T_WC: Float[Tensor, "4 4"],
        target: Float[Tensor, "H W 3"],
        *,
        pixel: tuple[int, int] | None = None,
    ):
        self.target = target
        self._read(params, camera, T_WC)
        pick = Choice(value=PICKS[0], options=PICKS, label="a click picks")
        super().__init__(
            self._draw,
            {"pick": pick, **pixel_sliders(camera, pixel)},
            name="gradient",
            kind="png",
            text="A rendered map, its photograph, and the direction of descent",
            touch=lambda stroke, _: touched_pixel(stroke, camera, PICTURE_PX / camera.height),
        )

    @property
    def row(self) -> int | None:
        """The Gaussian with the largest weight at the chosen pixel, ``None`` where there is
        none."""
        stack = self.of_pixel.stack
        return int(stack.row[stack.weight.argmax()]) if len(stack) else None

    @property
    def of_gaussian(self) -> GaussianGradient | None:
        """The gradient of that Gaussian from each pixel."""
        return None if self.row is None else gaussian_gradient(self.splats, self.v_rgb, self.row)

    def _draw(self, pick: str, u: int, v: int) -> Drawn:
        self.of_pixel = pixel_gradient(self.splats, self.v_rgb, u, v)
        n = self.target.numel()
        field = self.of_gaussian if pick == "Gaussian" else None
        if field is not None:
            lens = gaussian_gradient_picture(self.rendered, self.splats, field, size=PICTURE_PX)
            table = self._gaussian_table(field.row, 1 / n)
        else:
            lens = pixel_gradient_picture(
                self.rendered, self.splats, self.of_pixel, size=PICTURE_PX
            )
            table = pixel_gradient_table(self.of_pixel, 1 / n)
        pair = [
            with_cross(self.rendered, u, v, PICTURE_PX),
            resize_to_height(self.target, PICTURE_PX),
        ]
        unit = f"numbers are multiples of 1/{n:,}: L1 gives ±1 per pixel and channel"
        return side_by_side(
            [*pair, lens], ["rendered: click", "target", "descent"]
        ), f"pixel ({u}, {v}); {unit}{table}"

    def _read(self, params: GaussianParams, camera: Camera, T_WC: Tensor) -> None:
        """Render, and compute the gradient with respect to the projected Gaussians."""
        with torch.no_grad():
            self.splats = project_splats(params, camera, T_WC)
            p = self.splats.projection
            tiles = tile_intersections(p, camera)
            image = composite(
                p.uv,
                p.conic,
                p.opacity,
                self.splats.rgb,
                p.depth_m,
                tiles,
                camera,
                with_indices=False,
            )
            self.v_rgb = l1_vjp(image.rgb, self.target)
            self.rendered = to_uint8(image.rgb)
            self.total = composite_vjp(image.saved, self.v_rgb)

    def _gaussian_table(self, row: int, unit: float) -> str:
        g = self.total
        numbers = [*g.uv[row].tolist(), float(g.opacity[row]), *g.rgb[row].tolist()]
        heads = (f"Gaussian {row}", "dL/du", "dL/dv", "dL/do", "dL/dr", "dL/dg", "dL/db")
        return numbers_table(
            heads, [("sum over all pixels", *(f"{x / unit:+.2f}" for x in numbers))], n=1
        )
