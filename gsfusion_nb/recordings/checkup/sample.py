"""The frames that a check-up examines, read one by one and reduced to what it needs."""

from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ...data.adjust.depth_agreement import thinned
from ...data.adjust.poses import stored_poses
from ...data.sequence import BadFrameError, Sequence
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
    """Mean squared Laplacian of the grey image divided by its variance, which makes it independent of exposure."""
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
    """Positions to read: all, or windows of consecutive frames that are spread over the sequence."""
    if length <= frames:
        return list(range(length))
    windows = max(1, frames // WINDOW)
    starts = np.linspace(0, length - WINDOW, windows).round().astype(int)
    return sorted({int(s) + k for s in starts for k in range(WINDOW)})


def read_sample(sequence: Sequence, *, frames: int = 250, at: list[int] | None = None) -> Sample:
    """Read up to about ``frames`` frames, or those of the positions ``at``, one at a time; keep small copies."""
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
            facts.repeats = torch.equal(last.colour, frame.colour) or torch.equal(last.depth_m, frame.depth_m)
        last = frame
        sample.frames.append(facts)
    return sample


def _facts(frame: Frame, place: int, step: int) -> FrameFacts:
    grey = cv2.cvtColor(frame.rgb_u8.numpy(), cv2.COLOR_RGB2GRAY)
    h, w = grey.shape
    if w > GREY_WIDTH:
        grey = cv2.resize(grey, (GREY_WIDTH, round(h * GREY_WIDTH / w)), interpolation=cv2.INTER_AREA)
    _, stored = thinned(frame.camera, frame.depth_m, step)
    depth_m = without_speckle(stored.numpy())
    laplacian = cv2.Laplacian(grey, cv2.CV_16S)
    return FrameFacts(
        place=place,
        number=frame.index,
        T_stored=frame.T_WC.double(),
        grey=np.asarray(grey),
        depth_m=torch.from_numpy(depth_m),
        missing=float((stored <= 0).float().mean()),
        sharpness=float(np.mean(np.square(laplacian.astype(np.float32)))) / (float(grey.var()) + 1.0),
    )


_SPECKLED = 0.75
"""Where of the eight neighbours of a pixel with depth fewer have depth, on average, single pixels are missing: of a
hand-held Kinect 0.93 and more have."""
_FILLED_FROM = 3
"""Fewest pixels with depth among the 24 around one that is filled."""


def without_speckle(depth_m: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Depth of which single pixels are missing everywhere (a scanner, a projected LiDAR), filled with the median of the
    pixels around each; depth with holes, as other cameras have it, is copied.

    Frames are compared by interpolating depth between four pixels, which hardly ever all have it in such images.
    """
    known = depth_m > 0
    counts = cv2.boxFilter(known.astype(np.float32), -1, (3, 3), normalize=False, borderType=cv2.BORDER_REFLECT_101)
    if not known.any() or float((counts[known] - 1).mean()) >= 8 * _SPECKLED:
        return depth_m.copy()
    padded = np.pad(np.where(known, depth_m, np.nan), 2, constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, (5, 5)).reshape(*depth_m.shape, 25)
    fillable = ~known & (np.isfinite(around).sum(axis=2) >= _FILLED_FROM)
    filled = depth_m.copy()
    filled[fillable] = np.nanmedian(around[fillable], axis=1)
    return filled
