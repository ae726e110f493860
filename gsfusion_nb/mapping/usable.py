"""Whether a frame can be mapped at all."""

from ..checks import check_colours, check_finite, check_pose
from ..datasets import BadFrameError
from ..types import Frame

BLACK = 2.5 / 255
"""A frame with no brighter pixel was not exposed."""


def check_frame(frame: Frame, *, needs_depth: bool = False) -> Frame:
    """The frame itself, if it can be used.

    Args:
        frame: What is about to be mapped.
        needs_depth: Refuse one without any depth.

    Raises:
        BadFrameError: the pose is not rigid, an image holds a NaN or colours beyond 0..1, the picture is black, or
            there is no depth and ``needs_depth``.
    """
    try:
        check_pose(f"T_WC of frame {frame.index}", frame.T_WC)
        check_finite(f"depth_m of frame {frame.index}", frame.depth_m)
        check_colours(f"rgb of frame {frame.index}", frame.rgb)
        if float(frame.rgb.max()) < BLACK:
            raise ValueError("its picture is black; expected an exposed one")
        if needs_depth and not bool((frame.depth_m > 0).any()):
            raise ValueError("it has no depth at all; expected some above 0")
    except ValueError as e:
        raise BadFrameError(f"frame {frame.index} cannot be mapped: {e}") from None
    return frame
