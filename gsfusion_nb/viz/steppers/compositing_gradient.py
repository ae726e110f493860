"""A stepper through the gradient of one pixel's blending, back to front: S, dL/dalpha, and what
follows."""

from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...drawing.curves import BETWEEN, PALETTE, style
from ...types import Camera, GaussianParams
from .compositing import bars, count_steps, record_pixel
from .stepper import Step, Stepper, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def compositing_gradient_stepper(
    params: GaussianParams,
    camera: Camera,
    T_WC: Float[Tensor, "4 4"],
    pixel: tuple[int, int],
    v_rgb: Float[Tensor, "3"],
) -> Stepper:
    """Press Next through the Gaussians of one pixel, farthest first: S, dL/dalpha, and what follows
    from it.

    Above: the weights, with the Gaussian in question framed; below: dL/dalpha of each.

    Args:
        params, camera, T_WC, pixel: As for ``compositing_stepper``.
        v_rgb: dL/dC, the gradient of the loss with respect to the pixel's colour. [3]

    Raises:
        ValueError: the pixel is outside the image, or no Gaussian reaches it.
    """
    run = record_pixel(params, camera, T_WC, pixel, v_rgb)
    lines = run.recording
    dot = lines.at("c_dot_v = c @ v_C.T")[0]
    sums = lines.at("S = _sum_behind")[0]
    slope = lines.at("v_alpha_k = torch.where(moves")[0]
    colours = lines.at("return v_alpha_k, w @ v_C")[0]
    opacities = lines.at("v_opacity = (v_alpha * alpha)")[0]
    centres = lines.at("v_uv = -torch.stack")[0]
    T, w, c_dot_v, S, v_alpha = (
        slope[name][:, 0] for name in ("T", "w", "c_dot_v", "S", "v_alpha_k")
    )
    K = count_steps(w)
    steps: list[Step] = []
    for k in reversed(range(K)):
        v_so_far = torch.full((K,), torch.nan)
        v_so_far[k + 1 :] = v_alpha[k + 1 : K]
        scene = {"k": k, "v_alpha": v_so_far, "S": float(S[k])}
        who = f"Gaussian {k + 1} of {len(w)}"
        numbers = [("c . v_C", text_of(c_dot_v[k])), ("w", text_of(w[k])), ("T", text_of(T[k]))]
        title = f"{who}: how much its colour and the loss agree."
        steps.append(Step(dot, title, numbers, scene))
        numbers = [("S, sum over those behind", text_of(S[k]))]
        occluded_words = "there are none" if k == len(w) - 1 else "what this one hides"
        steps.append(
            Step(
                sums,
                f"S sums w (c . v_C) over the Gaussians behind it: {occluded_words}.",
                numbers,
                scene,
            )
        )
        scene = scene | {"v_alpha": torch.where(torch.arange(K) == k, v_alpha[:K], v_so_far)}
        numbers = [
            ("T (c . v_C)", text_of(T[k] * c_dot_v[k])),
            ("S / (1 − alpha)", text_of(S[k] / (1 - slope["alpha"][k, 0]))),
            ("dL/dalpha", text_of(v_alpha[k])),
        ]
        steps.append(Step(slope, _direction(float(v_alpha[k])), numbers, scene))
        numbers = [
            ("dL/dc = w v_C", text_of(colours["w @ v_C"][k, :3])),
            ("dL/dopacity", text_of(opacities["v_opacity"][k])),
            ("dL/d(u, v)", text_of(centres["v_uv"][k])),
        ]
        title = (
            "From dL/dalpha follow the gradients of its opacity and position; from w that of "
            "its colour."
        )
        steps.append(Step(opacities, title, numbers, scene))
    most = float(v_alpha[:K].abs().max()) or 1.0
    words = f"weights; dL/dC = {text_of(v_rgb, 3)}"
    return Stepper(
        steps,
        lambda figure, scene: _backward_picture(figure, scene, w[:K], run.rgb[:K], most, words),
        name="compositing-gradient",
        label=f"Gradient of pixel {pixel}",
    )


def _direction(v_alpha: float) -> str:
    if v_alpha == 0:
        return "dL/dalpha is 0: this Gaussian is not blended, or its alpha is at the limit of 0.99."
    return (
        f"dL/dalpha is {'positive: less' if v_alpha > 0 else 'negative: more'} of this Gaussian "
        "lowers the loss."
    )


def _backward_picture(
    figure: "Figure",
    scene: dict[str, Any],
    w: Tensor,
    rgb: Tensor,
    most: float,
    words: str,
) -> None:
    weight_axes = figure.add_axes((0.15, 0.60, 0.82, 0.32))
    gradient_axes = figure.add_axes((0.15, 0.13, 0.82, 0.38))
    style(weight_axes, y="weight", title=words)
    style(gradient_axes, x="Gaussian, nearest first", y="dL/dalpha")
    bars(weight_axes, w, rgb, width=0.7)
    bars(gradient_axes, scene["v_alpha"].nan_to_num(), rgb, width=0.7)
    weight_axes.set_ylim(0, 1.15 * float(w.max()) or 1)
    gradient_axes.set_ylim(-1.15 * most, 1.15 * most)
    gradient_axes.axhline(0, color=BETWEEN, linewidth=0.8)
    for axes in (weight_axes, gradient_axes):
        mark = 0.92 * axes.get_ylim()[1]
        axes.plot(
            scene["k"] + 1,
            mark,
            "v",
            color=PALETTE[3],
            markersize=7,
            clip_on=False,
        )
