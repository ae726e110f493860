"""Visibility and size in torch: the reference is vectorised; also in float64."""

from torch import Tensor

from gsfusion_nb.backends import load
from gsfusion_nb.render.on_screen import Footprints
from gsfusion_nb.types import Camera, GaussianParams


def footprints(params: GaussianParams, camera: Camera, T_WC: Tensor) -> Footprints:
    """See ``gsfusion_nb.render.on_screen``."""
    return load("footprints", "reference")(params, camera, T_WC)
