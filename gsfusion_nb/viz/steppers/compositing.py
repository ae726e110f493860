"""A stepper through the blending of one pixel, front to back: alpha, the light that is left,
weight, colour so far."""

import dataclasses
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.curves import BETWEEN, PALETTE, style
from ...errors import ArgumentError
from ...render import TileLists, composite, composite_vjp
from ...render.constants import TILE_PX
from ...types import Camera, GaussianParams
from ..panels.pixel_blend import camera_of_pixel, project_splats, reaching
from .recording import Recording, record
from .stepper import Step, Stepper, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


WATCH = {
    composite: {
        "composite": ("alpha", "w", "C[y, x]"),
        "splat_alpha": ("dx", "dy", "sigma", "alpha", "opacity"),
        "blend_weights": (
            "alpha",
            "T_behind",
            "T",
            "torch.where(T_behind >= TRANSMITTANCE_MIN, alpha * T, 0.0)",
        ),
        "blend": ("w", "c"),
        "composite_vjp": ("v_c", "v_uv", "v_opacity", "v_alpha_k"),
        "blend_vjp": (
            "T",
            "w",
            "c_dot_v",
            "S",
            "moves",
            "v_alpha_k",
            "w @ v_C",
            "alpha",
            "c",
            "v_C",
        ),
        "splat_alpha_vjp": ("v_opacity", "v_sigma", "v_uv"),
    }
}
WEIGHTS = "torch.where(T_behind >= TRANSMITTANCE_MIN, alpha * T, 0.0)"
_BEHIND_THE_STOP = 3
"""Gaussians behind the place where blending stops that are still shown."""


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PixelRun:
    """``composite`` of one pixel, and which rows of the map it blended, nearest first."""

    recording: Recording
    row: Tensor
    rgb: Float[Tensor, "K 3"]


def record_pixel(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    pixel: tuple[int, int],
    v_rgb: Float[Tensor, "3"] | None = None,
) -> PixelRun:
    """``composite`` of an image that is this one pixel, and then ``composite_vjp`` if ``v_rgb`` is
    given: a recording.

    Raises:
        ValueError: the pixel is outside the image, or no Gaussian reaches it.
    """
    splats = project_splats(params, camera, T_WC)
    p = splats.projection
    rows, _ = reaching(splats, *pixel)
    uv = p.uv - p.uv.new_tensor(pixel)
    rows = rows[p.depth_m[rows].argsort(stable=True)]
    if not len(rows):
        raise ArgumentError(f"no Gaussian reaches pixel {pixel}")
    one = camera_of_pixel(camera, *pixel)
    lists = TileLists(
        gaussian=rows,
        offset=torch.tensor([0, len(rows)]),
        tile_px=TILE_PX,
        tiles_x=1,
        tiles_y=1,
    )

    def run() -> Any:
        output = composite(
            uv,
            p.conic,
            p.opacity,
            splats.rgb,
            p.depth_m,
            lists,
            one,
        )
        return output, None if v_rgb is None else composite_vjp(output.saved, v_rgb.view(1, 1, 3))

    return PixelRun(
        recording=record(run, WATCH),
        row=rows,
        rgb=splats.rgb[rows],
    )


def compositing_stepper(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    pixel: tuple[int, int],
) -> Stepper:
    """Press Next through the Gaussians of one pixel, nearest first: alpha, the light that is left,
    weight and colour.

    Bars: alpha pale, weight in the Gaussian's colour; red steps: T; the square: the colour so far.

    Args:
        params: Gaussians.
        camera, T_WC: As for ``render``.
        pixel: Column and row.

    Raises:
        ValueError: the pixel is outside the image, or no Gaussian reaches it.
    """
    run = record_pixel(params, camera, T_WC, pixel)
    lines = run.recording
    alphas = lines.at("return torch.where(alpha >= ALPHA_MIN")[0]
    behinds = lines.at("T_behind = (1 - alpha).cumprod")[0]
    weights = lines.at("torch.where(T_behind >=")[0]
    end = lines.at("C[y, x] = blend")[0]
    sigma, alpha = (
        alphas[name][:, 0] if name == "sigma" else alphas["return"][:, 0]
        for name in ("sigma", "alpha")
    )
    T = weights["T"][:, 0]
    T_behind = behinds["T_behind"][:, 0]
    w = weights[WEIGHTS][:, 0]
    K = count_steps(w)
    steps = []
    colour = torch.zeros(3)
    for k in range(K):
        scene = {"k": k, "alpha": alpha[: k + 1], "w": w[:k], "T": T[:k], "colour": colour}
        who = f"Gaussian {k + 1} of {len(w)}, row {int(run.row[k])}"
        offset = f"({float(alphas['dx'][k]):.2f}, {float(alphas['dy'][k]):.2f}) px"
        numbers = [
            ("(dx, dy)", offset),
            ("opacity", text_of(alphas["opacity"][k])),
            ("sigma", text_of(sigma[k])),
        ]
        steps.append(
            Step(
                alphas,
                f"{who}: alpha at this pixel.",
                [*numbers, ("alpha", text_of(alpha[k]))],
                scene,
            )
        )
        numbers = [("T, light in front of it", text_of(T[k])), ("1 − alpha", text_of(1 - alpha[k]))]
        scene = scene | {"T": T[: k + 1]}
        passes = f"{100 * float(T_behind[k]):.3g} % of the light is left behind Gaussian {k + 1}."
        steps.append(
            Step(
                behinds,
                passes,
                [*numbers, ("T behind it", text_of(T_behind[k]))],
                scene,
            )
        )
        colour = colour + w[k] * run.rgb[k]
        scene = scene | {"w": w[: k + 1], "colour": colour}
        title = f"Its weight is alpha T = {float(w[k]):.4f}."
        if not w[k]:
            title = (
                "T behind it would be below 1e-4: the pixel is finished, and the weight is 0 "
                "from here on."
            )
        numbers = [
            ("w", text_of(w[k])),
            ("c", text_of(run.rgb[k], 3)),
            ("colour so far", text_of(colour, 3)),
        ]
        steps.append(Step(weights, title, numbers, scene))
    C = end["C[y, x]"][0]
    numbers = [
        ("C, colour", text_of(C[:3])),
        ("depth", f"{float(C[3]):.4f} m"),
        ("sum of the weights", text_of(C[4])),
    ]
    steps.append(
        Step(
            end,
            f"The pixel is the sum of w c over its {len(w)} Gaussians.",
            numbers,
            steps[-1].scene,
        )
    )
    return Stepper(
        steps,
        lambda figure, scene: _forward_picture(figure, scene, run.rgb[:K]),
        name="compositing",
        label=f"Compositing of pixel {pixel}",
    )


def count_steps(w: Tensor) -> int:
    """How many Gaussians have steps: those with a weight, and a few behind the place where blending
    stops."""
    used = int((w > 0).nonzero().max()) + 1 if bool((w > 0).any()) else 0
    return min(len(w), used + _BEHIND_THE_STOP)


def bars(axes: Any, height: Tensor, rgb: Tensor, **how: Any) -> None:
    """Bars over the Gaussians of a pixel, nearest first; the first ones of ``rgb``."""
    n = len(height)
    axes.bar(
        range(1, n + 1),
        height.numpy(),
        color=rgb[:n].clamp(0, 1).numpy(),
        edgecolor=BETWEEN,
        linewidth=0.6,
        **how,
    )
    axes.set_xlim(0.3, len(rgb) + 0.7)
    axes.locator_params(axis="x", integer=True)


def _forward_picture(figure: "Figure", scene: dict[str, Any], rgb: Tensor) -> None:
    axes = figure.add_axes((0.11, 0.13, 0.70, 0.79))
    corner = figure.add_axes((0.84, 0.13, 0.13, 0.17))
    style(axes, x="Gaussian, nearest first", y="w, alpha, T", title="alpha, weight, and T (red)")
    style(corner, title="colour")
    corner.imshow(
        scene["colour"].clamp(0, 1).numpy().reshape(1, 1, 3),
        aspect="auto",
    )
    corner.set(xticks=[], yticks=[])
    axes.set_ylim(0, 1.05)
    bars(axes, scene["alpha"], rgb, width=0.8, alpha=0.35)
    bars(axes, scene["w"], rgb, width=0.5)
    T = scene["T"].numpy()
    axes.plot(
        range(1, len(T) + 1),
        T,
        ".-",
        drawstyle="steps-mid",
        color=PALETTE[3],
        linewidth=1.8,
    )
    axes.plot(
        scene["k"] + 1,
        1.03,
        "v",
        color=PALETTE[3],
        markersize=7,
        clip_on=False,
    )
