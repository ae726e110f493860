"""Which frames can be mapped."""

import math

import torch

from ..checks import check_colours, check_finite, check_pose
from ..errors import ArgumentError, BadFrameError
from ..geometry.operands import check_place, check_plausible_camera
from ..types import Frame

BLACK = 2.5 / 255
"""A frame without any brighter pixel counts as black."""


def check_frame(
    frame: Frame, device: torch.device | None = None, *, needs_depth: bool = False
) -> Frame:
    """The frame itself on ``device``, if it can be mapped.

    Args:
        frame: The frame to check.
        device: Device to move it to; by default it stays where it is. The host waits for a GPU
            once.
        needs_depth: Refuse a frame without any depth.

    Raises:
        BadFrameError: the pose is not rigid or too far away, the camera is impossible
            (``check_plausible_camera``), an image holds a NaN or colours outside 0..1, the picture
            is black, or it has no depth with ``needs_depth``.
    """
    try:
        check_pose(f"T_WC of frame {frame.index}", frame.T_WC_cpu)
        check_place(f"T_WC of frame {frame.index}", frame.T_WC_cpu)
        check_plausible_camera("its camera", frame.camera)
        frame = frame if device is None else frame.to(device)
        _check_images(frame, needs_depth)
    except ValueError as e:
        raise BadFrameError(f"frame {frame.index} cannot be mapped: {e}") from None
    return frame


def _check_images(frame: Frame, needs_depth: bool) -> None:
    extremes = torch.stack(
        [x.float() for image in (frame.depth_m, frame.colour) for x in torch.aminmax(image)]
    )
    depth_low, depth_high, low, high = extremes.tolist()  # NaN if any value is
    if frame.is_8_bit:
        low = low / 255
        high = high / 255
    if not (math.isfinite(depth_low) and math.isfinite(depth_high)):
        check_finite(f"depth_m of frame {frame.index}", frame.depth_m)
    check_colours(f"rgb of frame {frame.index}", frame.colour, (low, high))
    if high < BLACK:
        raise ArgumentError("its picture is black; expected a picture with brighter pixels")
    if needs_depth and not depth_high > 0:
        raise ArgumentError("it has no depth at all; expected pixels with depth above 0")
