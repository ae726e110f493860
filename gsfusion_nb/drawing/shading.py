"""How a surface is lit in pictures: never so bright or so dark that its shape cannot be seen."""

import torch
from jaxtyping import Float
from torch import Tensor

NOTHING = (0.11, 0.13, 0.17)
"""Colour where there is no surface: darker than any surface of a lit picture."""
_GREY = 0.95
_AMBIENT = 0.34
_KEY = 0.50
_FILL = 0.15
_TO_KEY_C = (-0.45, -0.70, -0.55)
"""Towards the stronger lamp, at the upper left behind the camera: camera axes, x right, y down."""
_TO_FILL_C = (0.80, -0.10, -0.60)
"""Towards the weaker one, at the right."""
_HEAD_ON = 0.71
"""About the light on a surface that is seen from the front."""
_OF_COLOUR = 0.35
"""Share of a coloured surface's brightness that depends on the light: its colours show shadows of
their own."""


def light_on(normal_C: Float[Tensor, "*N 3"]) -> Float[Tensor, "*N"]:
    """Brightness of a grey surface under two lamps that go with the camera, 0.34 to 0.95.

        light = ambient + key max(n . l_key, 0) + fill max(n . l_fill, 0)

    A wall that is seen from the front is in the middle of that, so that what stands out of it is
    brighter on one side and darker on the other.

    Args:
        normal_C: Unit normals, towards the camera, in camera axes.
    """
    key, fill = (
        torch.nn.functional.normalize(torch.tensor(to, dtype=normal_C.dtype), dim=0).to(
            normal_C.device
        )
        for to in (_TO_KEY_C, _TO_FILL_C)
    )
    return _AMBIENT + _KEY * (normal_C @ key).clamp(min=0) + _FILL * (normal_C @ fill).clamp(min=0)


def shaded(
    normal_C: Float[Tensor, "*N 3"], rgb: Float[Tensor, "*N 3"] | None = None
) -> Float[Tensor, "*N 3"]:
    """Colours of a lit surface, 0..1.

    Args:
        normal_C: Unit normals, towards the camera, in camera axes.
        rgb: Its own colours, 0..1, of which a third follows the light; grey without them.
    """
    light = light_on(normal_C)[..., None]
    if rgb is None:
        return (_GREY * light).expand(normal_C.shape)
    return (rgb * (1 - _OF_COLOUR + _OF_COLOUR * light / _HEAD_ON)).clamp(0, 1)


def shaded_view(
    normal_C: Float[Tensor, "H W 3"],
    is_surface: Tensor,
    rgb: Float[Tensor, "H W 3"] | None = None,
) -> Float[Tensor, "H W 3"]:
    """A picture of a lit surface, with ``NOTHING`` where there is none.

    Args:
        normal_C, rgb: As for ``shaded``, of each pixel.
        is_surface: Which pixels show the surface. [H, W]
    """
    nothing = torch.tensor(NOTHING, dtype=normal_C.dtype, device=normal_C.device)
    return torch.where(is_surface[..., None], shaded(normal_C, rgb), nothing)
