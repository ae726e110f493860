"""What a projection needs of a camera."""

from gsfusion_nb.constants import FRUSTUM_CLAMP
from gsfusion_nb.types import Camera


def lens(camera: Camera) -> tuple[float, ...]:
    """fx, fy, cx, cy, and the largest |x / z| and |y / z| at which the projection is linearised."""
    limit_x = FRUSTUM_CLAMP * 0.5 * camera.width / camera.fx
    limit_y = FRUSTUM_CLAMP * 0.5 * camera.height / camera.fy
    return tuple(float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy, limit_x, limit_y))
