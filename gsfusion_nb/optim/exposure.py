"""The exposure of one view from its picture, while the map stays.

The exposure is one factor per colour channel between the map's picture and the photograph
(``fit_exposure``). A camera with auto exposure shows the same wall brighter in one picture than in
the next. An exposure multiplies the light; after the camera's gamma curve it multiplies the
colours, too, (g L)^(1/2.2) = g^(1/2.2) L^(1/2.2), until they are white. So three factors a view are
nearly all there is to know, and too few to hide an error of the map.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

PRIOR_PIXELS = 10.0
"""The prior at factor 1 counts as so many grey pixels."""

EVERY = 2
"""Every second pixel of every second row is used: three numbers need no more."""

WHITE = 0.98
"""Brighter pixels of the photograph may be cut off and do not count."""


def apply_exposure(
    rgb: Float[Tensor, "H W 3"],
    exposure: Float[Tensor, " 3"],
) -> Float[Tensor, "H W 3"]:
    """The map's picture as a camera with this exposure takes it. Differentiable:
    ``apply_exposure_vjp``."""
    return rgb * exposure


def apply_exposure_vjp(
    rgb: Float[Tensor, "H W 3"],
    exposure: Float[Tensor, " 3"],
    v_picture: Float[Tensor, "H W 3"],
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, " 3"]]:
    """dL/drgb = exposure v and dL/dexposure = the sum over the pixels of rgb v."""
    return exposure * v_picture, (rgb * v_picture).sum((0, 1))


def fit_exposure(
    rgb: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
    is_shown: Bool[Tensor, "H W"],
) -> Float[Tensor, " 3"]:
    """The factors with which the map's picture r fits the photograph t best: least squares, with a
    weak prior at 1.

        g = (sum r t + p / 4) / (sum r^2 + p / 4)

    with the sums over the pixels that the map shows and that are not white.

    Args:
        rgb: The map's picture.
        target: The photograph, 0..1.
        is_shown: Pixels that the map covers.

    Differentiable: no.
    """
    some = (slice(None, None, EVERY), slice(None, None, EVERY))
    used = (is_shown[some] & (target[some].amax(-1) < WHITE))[..., None]
    r = torch.where(used, rgb[some].clamp(0, 1), 0.0)
    t = torch.where(used, target[some], 0.0)
    prior = PRIOR_PIXELS / 4 / EVERY**2
    return ((r * t).sum((0, 1)) + prior) / ((r * r).sum((0, 1)) + prior)
