"""The pose and the camera that the splat viewer starts with."""

from jaxtyping import Float
from torch import Tensor

from ...checks import check_pose
from ...evaluation import expected_depth_m
from ...render import render
from ...types import Camera, GaussianParams
from ..viewpoint import Viewpoint, extent

_FOCAL_PER_WIDTH = 0.7
"""Focal length / image width of a viewer without a camera: a 71 degree wide view."""


def viewing_camera(camera: Camera | None, width: int | None, height: int | None) -> Camera:
    """The given camera for a canvas of the given size, with its horizontal angle of view.

    By default the canvas has the camera's size, at most 640 pixels wide; without a camera it is 480 x 360.
    """
    if camera is None:
        w, h = width or 480, height or 360
        return Camera(width=w, height=h, fx=_FOCAL_PER_WIDTH * w, fy=_FOCAL_PER_WIDTH * w, cx=w / 2, cy=h / 2)
    if width is None:
        width = min(camera.width, 640) if height is None else round(height * camera.width / camera.height)
    scaled = camera.resized(width, round(width * camera.height / camera.width))
    if height is None or height == scaled.height:
        return scaled
    return Camera(
        width=width, height=height, fx=scaled.fx, fy=scaled.fy,
        cx=scaled.cx, cy=scaled.cy + (height - scaled.height) / 2,
    )  # fmt: skip


def starting_pose(
    params: GaussianParams, camera: Camera, T_WC: Float[Tensor, "4 4"] | None, up_W: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "4 4"], float]:
    """The first pose, and the distance of the point to turn around (the median depth of the view), metres.

    Without a pose it is a view of the whole map from 35 degrees above.
    """
    centre_W, radius_m = extent(params.xyz_W)
    if T_WC is None:
        x, y, z = centre_W.tolist()
        half_view = min(0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy)
        distance_m = 0.9 * radius_m / half_view
        view = Viewpoint(target_W=(x, y, z), azimuth_deg=-60.0, elevation_deg=35.0, distance_m=distance_m)
        return view.pose(up_W), distance_m
    check_pose("T_WC", T_WC)
    pose = T_WC.detach().cpu().float()
    depth_m = expected_depth_m(render(params, camera, pose))
    seen = depth_m[depth_m > 0]
    return pose, float(seen.median()) if len(seen) else radius_m
