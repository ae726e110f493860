"""What a reader of a foreign format returns: frames whose images are decoded only on request."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from torch import Tensor

from ...data.lens.camera_model import CameraModel
from ...data.sequence import SequenceError
from ...operands import check_depth_scale, check_plausible_camera


@dataclass(frozen=True, eq=False)
class RgbdImages:
    """Decoded colour and depth of one frame; they may differ in size."""

    rgb: np.ndarray
    """uint8. [H, W, 3]"""
    depth_m: np.ndarray
    """float32, metres, 0 = missing. [h, w]"""
    encoded: bytes = b""
    """The JPEG or PNG file that ``rgb`` came from: written unchanged if no pixel has to change."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedFrame:
    """One frame of a recording.

    Raises:
        SequenceError: an impossible camera (``gsfusion_nb.operands``).
    """

    source: str
    """Where it came from, for messages."""
    time_s: float | None
    """Seconds; None where the format has no times."""
    model: CameraModel | None
    """Camera of the colour image; None if the format has none; then the user must give it."""
    load: Callable[[], RgbdImages]
    """Decode the images. Raises ``BadFrameError``; valid only until the iterator goes on to the next frame."""
    T_WC: Float[Tensor, "4 4"] | None = None
    """Camera-to-world, OpenCV axes, as stored; None where it is unknown."""
    depth_model: CameraModel | None = None
    """Camera of the depth image; None: depth is registered to the colour image, whatever its size."""
    T_colour_depth: Float[Tensor, "4 4"] | None = None
    """From the depth camera's frame to the colour camera's; None: they are one camera."""

    def __post_init__(self):
        for kind, model in (("colour", self.model), ("depth", self.depth_model)):
            if model is not None:
                try:
                    check_plausible_camera(f"{self.source}: {kind} camera", model.camera)
                except ValueError as e:
                    raise SequenceError(str(e)) from None


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """A recording in a foreign format.

    Raises:
        SequenceError: an impossible depth scale (``gsfusion_nb.operands``).
    """

    name: str
    frames: Callable[[], Iterator[RecordedFrame]]
    """In order; a new iterator on each call."""
    n_frames: int
    depth_scale: float = 1000.0
    """Stored depth value of one metre, which the written images keep."""
    depth_along_ray: bool = False
    has_poses: bool = True
    up_to_scale: bool = False
    """Whether the poses have no unit of length."""
    measured_scale: Callable[[], tuple[float, str]] | None = None
    """Metres per unit of the poses, found on the depth images, with a sentence on how certain that is."""
    dropped: dict[str, int] = field(default_factory=dict)
    """Frames that the reader already left out, by reason."""
    notes: tuple[str, ...] = ()
    """Sentences on what was assumed or found."""

    def __post_init__(self):
        try:
            check_depth_scale(self.name, self.depth_scale)
        except ValueError as e:
            raise SequenceError(str(e)) from None
