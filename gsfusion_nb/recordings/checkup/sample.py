"""The frames that a check-up examines, read one by one and reduced to what it needs."""

from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ...data.adjust.depth_agreement import thinned
from ...data.adjust.poses import stored_poses
from ...data.adjust.small_images import small_grey, without_speckle
from ...data.adjust.steps import repeated_image
from ...data.sequence import Sequence
from ...errors import BadFrameError
from ...types import Camera, Frame

WINDOW = 31
"""Number of consecutive frames per window, if a sequence is too long to be read completely."""
DEPTH_WIDTH = 320
"""Depth for reprojection is subsampled to about this width, pixels."""
GREY_WIDTH = 320
"""Grey images are averaged down to at most this width, pixels."""


@dataclass(kw_only=True, eq=False)
class FrameFacts:
    """The stored values of one frame. Images are small copies."""

    place: int
    """Position in the sequence that is read."""
    number: int
    """Frame number in the recording, for messages and repairs."""
    T_stored: Float[Tensor, "4 4"]
    """Pose as returned by the reader, float64."""
    grey: UInt8[np.ndarray, "h w"]
    depth_m: Float[Tensor, "h w"]
    missing: float
    """Share of pixels without depth."""
    sharpness: float
    """Mean squared Laplacian of the grey image divided by its variance, which makes it independent
    of exposure."""
    repeats: bool = False
    """Whether every pixel of the colour or of the depth image is that of the frame before."""


@dataclass(kw_only=True, eq=False)
class Sample:
    """The frames that were read, and those that could not be."""

    name: str
    length: int
    """Frames in the whole sequence."""
    camera: Camera
    """Camera of the full images."""
    depth_camera: Camera
    """Camera of the subsampled depth images."""
    stored_poses: Float[Tensor, "L 4 4"]
    """Poses of all frames as returned by the reader, float64; NaN where it raises an error."""
    frames: list[FrameFacts] = field(default_factory=list)
    unreadable: dict[int, str] = field(default_factory=dict)
    """Position -> why the frame could not be used."""

    @property
    def by_place(self) -> dict[int, FrameFacts]:
        """Frames by their position in the sequence."""
        return {f.place: f for f in self.frames}


def places(length: int, frames: int) -> list[int]:
    """Positions to read: all, or windows of consecutive frames that are spread over the
    sequence."""
    if length <= frames:
        return list(range(length))
    windows = max(1, frames // WINDOW)
    starts = np.linspace(0, length - WINDOW, windows).round().astype(int)
    return sorted({int(s) + k for s in starts for k in range(WINDOW)})


def read_sample(
    sequence: Sequence,
    *,
    frames: int = 250,
    at: list[int] | None = None,
) -> Sample:
    """Read up to about ``frames`` frames, or those of the positions ``at``, one at a time; keep
    small copies."""
    camera = sequence.camera
    step = max(1, round(camera.width / DEPTH_WIDTH))
    depth_camera, _ = thinned(camera, torch.zeros(camera.height, camera.width), step)
    sample = Sample(
        name=sequence.name,
        length=len(sequence),
        camera=camera,
        depth_camera=depth_camera,
        stored_poses=stored_poses(sequence),
    )
    last: Frame | None = None
    for place in places(len(sequence), frames) if at is None else at:
        try:
            frame = sequence[place]
        except BadFrameError as e:
            sample.unreadable[place] = str(e)
            continue
        facts = _facts(frame, place, step)
        if last is not None:
            facts.repeats = bool(repeated_image(last, frame))
        last = frame
        sample.frames.append(facts)
    return sample


def _facts(frame: Frame, place: int, step: int) -> FrameFacts:
    grey = small_grey(frame, GREY_WIDTH)
    _, small_depth_m = thinned(frame.camera, frame.depth_m, step)
    depth_m = without_speckle(small_depth_m.numpy())
    laplacian = cv2.Laplacian(grey, cv2.CV_16S)
    return FrameFacts(
        place=place,
        number=frame.index,
        T_stored=frame.T_WC.double(),
        grey=grey,
        depth_m=torch.from_numpy(depth_m),
        missing=float((small_depth_m <= 0).float().mean()),
        sharpness=float(np.mean(np.square(laplacian.astype(np.float32))))
        / (float(grey.var()) + 1.0),
    )
