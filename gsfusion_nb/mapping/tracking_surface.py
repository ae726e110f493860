"""The map's surface, to which frames are aligned where poses are tracked."""

import functools
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..geometry import depth_to_normals
from ..render import blended_depth_m
from ..tracking import Surface, localise
from ..types import Camera, Frame, RenderOutput
from .check_frame import check_frame
from .usual_torch import changeable, in_usual_torch


def tracking_surface(mapper: Any, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> Surface:
    """What a frame at this pose is aligned to: the surface of the mapper's map."""
    return surface_seen(mapper.surface(camera, T_WC), camera, T_WC)


def surface_seen(seen: Any, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> Surface:
    """What ``Mapper.surface`` gives, as a frame is aligned to it."""
    return Surface(
        depth_m=seen.depth_m,
        normal_W=seen.normal_W,
        camera=camera,
        T_WC=T_WC,
        rgb=seen.rgb,
    )


def surface_of_picture(
    picture: RenderOutput, camera: Camera, T_WC: Float[Tensor, "4 4"]
) -> Surface:
    """The surface that a picture of Gaussians shows, with the normals of its depth."""
    depth_m = picture.surface_depth_m
    depth_m = blended_depth_m(picture) if depth_m is None else depth_m
    normal_C = depth_to_normals(camera, depth_m)
    return Surface(
        depth_m=depth_m,
        normal_W=normal_C @ T_WC.to(normal_C)[:3, :3].T,
        camera=camera,
        T_WC=T_WC,
        rgb=picture.rgb,
    )


@in_usual_torch
def localised_pose(mapper: Any, frame: Frame) -> Float[Tensor, "4 4"] | None:
    """Where a frame that is not mapped was taken: aligned with the map, from between the mapped
    frames around it.

    Nothing changes. ``None``: it fits nowhere there.

    Raises:
        BadFrameError: the frame cannot be used (``check_frame``).
    """
    needs_depth = mapper.description.needs_depth
    frame = check_frame(changeable(frame), mapper.device, needs_depth=needs_depth)
    source = functools.partial(tracking_surface, mapper)
    guess = mapper.trajectory.pose_near(frame.index)
    return localise(frame, source, guess, mapper.config.tracking)
