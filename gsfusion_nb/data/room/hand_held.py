"""The built-in room as somebody's own recording: TUM-style files with the mistakes of real ones.

hand_held/
  rgb.txt  depth.txt  groundtruth.txt      lists with time stamps, as of the TUM RGB-D benchmark
  rgb/<timestamp>.jpg  depth/<timestamp>.png
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ...errors import ArgumentError
from ...geometry import quaternion
from ...types import Camera
from .sequence import RoomSequence


def write_rgb(path: Path, rgb: np.ndarray) -> None:
    """Write an RGB image, uint8 [H, W, 3], as ``.jpg`` (quality 97, colour at full resolution) or
    ``.png``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    jpeg = path.suffix.lower() == ".jpg"
    whole_colour = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    options = (
        [cv2.IMWRITE_JPEG_QUALITY, 97, *whole_colour] if jpeg else [cv2.IMWRITE_PNG_COMPRESSION, 3]
    )
    path.write_bytes(cv2.imencode(".jpg" if jpeg else ".png", rgb[..., ::-1], options)[1].tobytes())


def write_depth(path: Path, depth_m: np.ndarray, scale: float) -> None:
    """Write depth in metres [H, W] as a 16-bit PNG with ``scale`` units per metre; 0 stays 0."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", np.rint(depth_m * scale).astype(np.uint16))[1].tobytes())


FIRST_S = 1305031102.0
"""Time of the first image."""

POSES_PER_IMAGE = 4
"""Poses are measured this many times as often as images."""


@dataclass(frozen=True, kw_only=True)
class HandHeld:
    """A short hand-held recording of the room, and what is wrong with it. The usual values have
    every mistake."""

    n_images: int = 40
    width: int = 160
    height: int = 120
    fps: float = 10.0
    """Images per second."""
    images_per_walk: int = 400
    """Images of which the whole walk through the room would have; fewer: faster motion."""
    noise: str = "kinect"
    """Errors of the depth camera: "kinect", "stereo" or "none"."""
    depth_units: float = 1000.0
    """Stored value of one metre. The TUM layout means 5000."""
    pose_delay_s: float = 0.15
    """The clock of the poses is this late: an image belongs to the pose with a time stamp that is
    later by this."""
    colour_shift_px: tuple[float, float] = (5.0, -3.0)
    """Colour is not registered to depth: its content lies this far to the right and down."""
    dark_after: float = 0.7
    """From this part of the recording on, the exposure is shorter by ``dark_stops``; 1: never."""
    dark_stops: float = 0.9
    blurred: tuple[int, ...] = (17, 30)
    """Images in which the hand shook during the exposure."""
    seed: int = 0

    @property
    def sequence(self) -> RoomSequence:
        """The room without the mistakes, seen at the time of every pose; image k is frame
        ``POSES_PER_IMAGE * k``."""
        n = POSES_PER_IMAGE * self.images_per_walk
        return RoomSequence(
            n_frames=n,
            width=self.width,
            height=self.height,
            noise=self.noise,
            seed=self.seed,
        )

    @property
    def camera(self) -> Camera:
        """The true intrinsics, which such a recording does not store."""
        return self.sequence.camera


def write_hand_held(folder: str | Path, recording: HandHeld | None = None) -> Path:
    """Write a hand-held recording of the built-in room; returns its folder.

    Args:
        folder: New folder.
        recording: Length, size and mistakes.

    Raises:
        FileExistsError: the folder exists. ValueError: more images than the walk has.
    """
    settings = recording or HandHeld()
    root = Path(folder)
    if not 2 <= settings.n_images <= settings.images_per_walk:
        raise ArgumentError(
            f"n_images must be between 2 and {settings.images_per_walk}, got {settings.n_images}"
        )
    root.mkdir(parents=True)
    sequence = settings.sequence
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for k in range(settings.n_images):
        frame = sequence[POSES_PER_IMAGE * k]
        time_s = f"{FIRST_S + k / settings.fps:.6f}"
        write_rgb(root / f"rgb/{time_s}.jpg", _photographed(frame.rgb_u8.numpy(), k, settings))
        write_depth(root / f"depth/{time_s}.png", frame.depth_m.numpy(), settings.depth_units)
        lists["rgb"].append(f"{time_s} rgb/{time_s}.jpg")
        lists["depth"].append(f"{time_s} depth/{time_s}.png")
    lists["groundtruth"] = _pose_lines(sequence, settings)
    for name, lines in lists.items():
        (root / f"{name}.txt").write_text(
            "\n".join(["# a hand-held recording", *lines, ""]), encoding="utf-8"
        )
    return root


def _pose_lines(sequence: RoomSequence, settings: HandHeld) -> list[str]:
    """Lines "timestamp tx ty tz qx qy qz qw", from before the first image to after the last one."""
    step_s = 1 / (POSES_PER_IMAGE * settings.fps)
    n = min(len(sequence), POSES_PER_IMAGE * (settings.n_images + 4))
    lines = []
    for i in range(n):
        T_WC = sequence.pose(i).double()
        row = [*T_WC[:3, 3].tolist(), *quaternion.from_matrix(T_WC[:3, :3])[[1, 2, 3, 0]].tolist()]
        stamp = FIRST_S + 0.004 + i * step_s + settings.pose_delay_s
        lines.append(f"{stamp:.6f} " + " ".join(f"{value:.9f}" for value in row))
    return lines


def _photographed(rgb: np.ndarray, k: int, settings: HandHeld) -> np.ndarray:
    """The colour image with blur, exposure and shift of this recording."""
    image = rgb
    if k in settings.blurred:
        image = cv2.blur(image, (max(9, settings.width // 12), 1))
    if k >= settings.dark_after * settings.n_images:
        linear = (image / 255.0) ** 2.2 * 2.0**-settings.dark_stops
        image = np.rint(linear ** (1 / 2.2) * 255).astype(np.uint8)
    move = np.array(
        [[1.0, 0.0, settings.colour_shift_px[0]], [0.0, 1.0, settings.colour_shift_px[1]]]
    )
    return cv2.warpAffine(
        image,
        move,
        (settings.width, settings.height),
        borderMode=cv2.BORDER_REPLICATE,
    )
