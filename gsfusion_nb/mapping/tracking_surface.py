"""The map's surface, to which frames are aligned where poses are tracked."""

import functools
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..tracking import Surface, localise
from ..types import Camera, Frame
from .check_frame import check_frame
from .usual_torch import changeable, in_usual_torch


def tracking_surface(mapper: Any, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> Surface:
    """What a frame at this pose is aligned to: the surface of the mapper's map."""
    seen = mapper.surface(camera, T_WC)
    return Surface(
        depth_m=seen.depth_m,
        normal_W=seen.normal_W,
        camera=camera,
        T_WC=T_WC,
        rgb=seen.rgb,
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
    guess = mapper.localiser.pose_near(frame.index)
    return localise(frame, source, guess, mapper.config.tracking)
