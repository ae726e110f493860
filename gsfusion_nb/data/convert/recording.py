"""What a reader of a foreign format hands over: shots whose images are decoded when asked for."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from torch import Tensor

from ..lens.camera_model import CameraModel


@dataclass(frozen=True, eq=False)
class Pictures:
    """Decoded colour and depth of one shot; they may differ in size."""

    rgb: np.ndarray
    """uint8. [H, W, 3]"""
    depth_m: np.ndarray
    """float32, metres, 0 = missing. [h, w]"""
    encoded: bytes = b""
    """The JPEG or PNG file that ``rgb`` came from: written as it is where no pixel has to change."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """One frame of a recording."""

    source: str
    """Where it came from, for messages."""
    time_s: float | None
    """Seconds; None where the format has no times."""
    model: CameraModel | None
    """Camera of the colour image; None where the format has none and it must be given."""
    load: Callable[[], Pictures]
    """Decode the images. Raises ``BadFrameError``; valid until the next shot is asked for."""
    T_WC: Float[Tensor, "4 4"] | None = None
    """Camera-to-world, OpenCV axes, as stored; None where it is unknown."""
    depth_model: CameraModel | None = None
    """Camera of the depth image; None: depth is registered to the colour image, whatever its size."""
    T_colour_depth: Float[Tensor, "4 4"] | None = None
    """From the depth camera's frame to the colour camera's; None: they are one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """A recording in a foreign format."""

    name: str
    shots: Callable[[], Iterator[Shot]]
    """In order; a new iterator on each call."""
    n_shots: int
    depth_scale: float = 1000.0
    """Stored depth of one metre, which is kept in what is written."""
    depth_along_ray: bool = False
    has_poses: bool = True
    up_to_scale: bool = False
    """The poses have no unit of length."""
    measured_scale: Callable[[], tuple[float, str]] | None = None
    """Metres per unit of the poses, found on the depth images, with a sentence on how sure that is."""
    dropped: dict[str, int] = field(default_factory=dict)
    """Frames that the reader already left out, by reason."""
    notes: tuple[str, ...] = ()
    """Sentences on what was assumed or found."""
