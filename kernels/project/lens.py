"""What a projection needs of a camera."""

from typing import NamedTuple

from gsfusion_nb.constants import FRUSTUM_CLAMP
from gsfusion_nb.types import Camera


class ProjectionLens(NamedTuple):
    """Focal lengths, principal point, and the largest |x / z| and |y / z| at which the projection is linearised."""

    fx: float
    fy: float
    cx: float
    cy: float
    limit_x: float
    limit_y: float


def projection_lens(camera: Camera) -> ProjectionLens:
    """Those of ``camera``."""
    return ProjectionLens(
        fx=float(camera.fx),
        fy=float(camera.fy),
        cx=float(camera.cx),
        cy=float(camera.cy),
        limit_x=FRUSTUM_CLAMP * 0.5 * camera.width / camera.fx,
        limit_y=FRUSTUM_CLAMP * 0.5 * camera.height / camera.fy,
    )
