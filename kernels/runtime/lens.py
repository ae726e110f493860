"""The numbers of a pinhole camera, as kernels take them."""

from collections.abc import Callable
from typing import Any, NamedTuple

from gsfusion_nb.types import Camera


class Lens(NamedTuple):
    """Focal lengths and principal point, pixels."""

    fx: Any
    fy: Any
    cx: Any
    cy: Any


def lens_of(camera: Camera, number: Callable[[float], Any] = float) -> Lens:
    """Those of ``camera``, each as a ``number``: its precision in the kernel."""
    return Lens(fx=number(camera.fx), fy=number(camera.fy), cx=number(camera.cx), cy=number(camera.cy))
