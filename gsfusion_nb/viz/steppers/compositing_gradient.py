"""A stepper through the gradient of one pixel's blending, back to front: S, dL/dalpha, and what follows from it."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.curves import BETWEEN, PALETTE
from ...types import Camera, GaussianParams
from .compositing import Bars, record_pixel, shown
from .stepper import Step, Stepper, moving, step_of, style, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def compositing_gradient_stepper(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    pixel: tuple[int, int],
    v_rgb: Float[Tensor, "3"],
) -> Stepper:
    """Press Next through the Gaussians of one pixel, farthest first: S, dL/dalpha, and what follows from it.

    Above: the weights, with the Gaussian in question framed; below: dL/dalpha of each.

    Args:
        params, camera, T_WC, pixel: As for ``compositing_stepper``.
        v_rgb: dL/dC, the gradient of the loss with respect to the pixel's colour. [3]

    Raises:
        ValueError: the pixel is outside the image, or no Gaussian reaches it.
    """
    run = record_pixel(params, camera, T_WC, pixel, v_rgb)
    lines = run.recording
    dot, sums = lines.at("c_dot_v = c @ v_C.T")[0], lines.at("S = _sum_behind")[0]
    slope, colours = lines.at("v_alpha_k = torch.where(moves")[0], lines.at("return v_alpha_k, w @ v_C")[0]
    opacities, centres = lines.at("v_opacity = (v_alpha * alpha)")[0], lines.at("v_uv = -torch.stack")[0]
    T, w, c_dot_v, S, v_alpha = (slope[name][:, 0] for name in ("T", "w", "c_dot_v", "S", "v_alpha_k"))
    K = shown(w)
    steps: list[Step] = []
    for k in reversed(range(K)):
        seen = torch.full((K,), torch.nan)
        seen[k + 1 :] = v_alpha[k + 1 : K]
        scene = {"k": k, "v_alpha": seen, "S": float(S[k])}
        who = f"Gaussian {k + 1} of {len(w)}"
        numbers = [("c . v_C", text_of(c_dot_v[k])), ("w", text_of(w[k])), ("T", text_of(T[k]))]
        title = f"{who}: how much its colour and the loss agree."
        steps.append(step_of(dot, title, numbers, scene))
        numbers = [("S, sum over those behind", text_of(S[k]))]
        behind = "there are none" if k == len(w) - 1 else "what this one hides"
        steps.append(step_of(sums, f"S sums w (c . v_C) over the Gaussians behind it: {behind}.", numbers, scene))
        scene = scene | {"v_alpha": torch.where(torch.arange(K) == k, v_alpha[:K], seen)}
        numbers = [
            ("T (c . v_C)", text_of(T[k] * c_dot_v[k])),
            ("S / (1 − alpha)", text_of(S[k] / (1 - slope["alpha"][k, 0]))),
            ("dL/dalpha", text_of(v_alpha[k])),
        ]  # fmt: skip
        steps.append(step_of(slope, _direction(float(v_alpha[k])), numbers, scene))
        numbers = [
            ("dL/dc = w v_C", text_of(colours["w @ v_C"][k, :3])), ("dL/dopacity", text_of(opacities["v_opacity"][k])),
            ("dL/d(u, v)", text_of(centres["v_uv"][k])),
        ]  # fmt: skip
        title = "From dL/dalpha follow the gradients of its opacity and position; from w that of its colour."
        steps.append(step_of(opacities, title, numbers, scene))
    bars = Bars(w[:K], run.rgb[:K], ("weight", f"weights; dL/dC = {text_of(v_rgb, 3)}"))
    most = float(v_alpha[:K].abs().max())
    return Stepper(
        steps, lambda figure: _backward_picture(figure, bars, most), name="compositing-gradient",
        label=f"Gradient of pixel {pixel}", stills=(2, min(10, len(steps) - 1), len(steps) - 1),
    )  # fmt: skip


def _direction(v_alpha: float) -> str:
    if v_alpha == 0:
        return "dL/dalpha is 0: this Gaussian is not blended, or its alpha is at the limit of 0.99."
    return f"dL/dalpha is {'positive: less' if v_alpha > 0 else 'negative: more'} of this Gaussian lowers the loss."


def _backward_picture(figure: "Figure", bars: Bars, most: float) -> Callable[[Step], None]:
    above, below = figure.add_axes((0.15, 0.60, 0.82, 0.32)), figure.add_axes((0.15, 0.13, 0.82, 0.38))
    style(above, y=bars.words[0], title=bars.words[1])
    style(below, x="Gaussian, nearest first", y="dL/dalpha")
    bars.on(above, width=0.7)
    above.set_ylim(0, 1.15 * float(bars.height.max()) or 1)
    below.axhline(0, color=BETWEEN, linewidth=0.8)
    below.set_ylim(-1.15 * most or -1, 1.15 * most or 1)
    slopes = bars.on(below, width=0.7, animated=True)
    marks = [moving(axes, "v", color=PALETTE[3], markersize=7, clip_on=False) for axes in (above, below)]

    def update(step: Step) -> None:
        for bar, value in zip(slopes, step.scene["v_alpha"].nan_to_num().tolist(), strict=True):
            bar.set_height(value)
        for mark, axes in zip(marks, (above, below), strict=True):
            mark.set_data([step.scene["k"] + 1], [0.92 * axes.get_ylim()[1]])

    return update
