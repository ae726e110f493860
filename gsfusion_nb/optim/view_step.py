"""One gradient step on one view, which every system takes in the same way."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..config import OptimConfig
from ..gaussians import GaussianModel
from ..large_maps import MapPart
from ..types import GaussianParams
from .losses import ViewLoss
from .map_step import AdamSettings, UpdateFunction, adam_step

PictureVjp = Callable[..., GaussianParams]
"""``vjp(v_rgb, v_depth_m, v_alpha, **outputs)``: dL/dparams from dL/d of the images of a picture.
``outputs`` are those of ``render_vjp``, which it fills."""

Render = Callable[[GaussianParams], tuple[Any, PictureVjp]]
"""``render(params)``: the picture of a view, with ``rgb``, as a system shows it, and its
gradient."""

Loss = Callable[[Any], tuple[ViewLoss, Float[Tensor, ""] | None]]
"""``loss(picture)``: its loss, and the mean squared error where it is computed with it."""

Regulariser = Callable[[GaussianParams], Float[Tensor, ""] | float]
"""``regulariser(gradients)``: adds, in place, the gradient of what is asked of the Gaussians
themselves. Returns its share of the reported loss."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewStep:
    """A gradient step on one view, as it was before it. All are tensors, because waiting for them
    after every step would leave a GPU idle."""

    loss: Float[Tensor, ""]
    mse: Float[Tensor, ""] | None
    """Mean squared error of the picture; None if nobody asked for it."""
    rgb: Float[Tensor, "H W 3"]
    """The picture."""


def optimise_view(
    part: GaussianModel | MapPart,
    render: Render,
    loss: Loss,
    config: OptimConfig | AdamSettings,
    *,
    regulariser: Regulariser | None = None,
    update: UpdateFunction | None = None,
    outputs: Mapping[str, Tensor | None] = MappingProxyType({}),
) -> ViewStep:
    """Draw a view, compare it, and move the Gaussians once against the gradient.

    Args:
        part: What of the map is optimised, changed in place.
        render: Draws the view.
        loss: Compares the picture with the view.
        config: Learning rates and decays.
        regulariser: Terms of the loss that are about Gaussians, not pixels.
        update: Takes the step of each column instead of Adam.
        outputs: ``v_uv`` and ``v_uv_abs`` of ``render_vjp``, to be filled.
    """
    picture, vjp = render(part.params)
    view_loss, mse = loss(picture)
    gradients = vjp(view_loss.v_rgb, view_loss.v_depth_m, view_loss.v_alpha, **outputs)
    if view_loss.v_params:
        of_params = {name: getattr(gradients, name) + v for name, v in view_loss.v_params.items()}
        gradients = dataclasses.replace(gradients, **of_params)
    value = view_loss.value
    if regulariser is not None:
        value = value + regulariser(gradients)
    adam_step(part, gradients, config, update)
    return ViewStep(loss=value, mse=mse, rgb=picture.rgb)
