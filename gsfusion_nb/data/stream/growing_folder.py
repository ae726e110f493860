"""A folder in the plain layout, read while another program writes it."""

import logging
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...types import Frame
from ..readers.folder import CAMERA_KEYS, read_intrinsics
from ..recorded.camera_json import camera
from ..recorded.find_files import given_name, natural_order
from ..recorded.poses import no_poses
from ..recorded.recorded_sequence import RecordedSequence
from ..sequence import BadFrameError, SequenceError, SequenceNotFoundError
from .complete_image import is_complete_image
from .frame_queue import Policy
from .live_source import LiveSource
from .poses_of_images import PosesOfImages

log = logging.getLogger(__name__)

_SUFFIXES = {"rgb": (".jpg", ".jpeg", ".png"), "depth": (".png", ".tif", ".tiff", ".pgm")}

_LOOK_AT = 64
"""At most this many waiting frames are checked in one round."""


@dataclass
class _Waiting:
    """A frame that has some of its files."""

    rgb: Path
    sizes: tuple[int, int] = (-1, -1)
    """Sizes of its two files at the last check, bytes; -1 if missing."""
    settled: bool = False
    """Whether they had the same sizes in the previous round."""


class GrowingFolder(LiveSource):
    """Frames of a folder in the plain layout (``gsfusion_nb.data.readers.folder``) as they are written.

    A frame counts when both its images have kept their sizes for one round and end as they should, and, unless the
    camera is to be tracked, its line of ``poses.txt`` is written. A line belongs to the image whose name it begins
    with; lines of numbers alone belong to images by the number in their names, from 0 or ``first_image`` on, so that a
    missing image does not shift the poses (``PosesOfImages``). Frames come in natural order of their names. One that
    stays incomplete for ``patience_s`` while later ones are there raises ``BadFrameError``, and so does a later file
    that sorts before the frames already taken; poses are waited for.

    The iteration ends after the last frame when a file named ``stop_file`` is in the folder or nothing has changed for
    ``idle_s``, or immediately with ``stop``.

    Args:
        path: The folder; it may still be empty, but must exist.
        poses: False: there is no ``poses.txt``; the camera must be tracked.
        poll_s: Time between two rounds, seconds.
        idle_s: End after this time without any change, seconds.
        patience_s: Skip an incomplete frame after this time, seconds.
        stop_file: Name of the file that ends the recording.
        wait: Function that waits for a number of seconds; for tests.

    Raises:
        SequenceNotFoundError: no such folder. SequenceError, while iterating: it is not clear which line of
            ``poses.txt`` belongs to an image.
    """

    policy: Policy = "all"

    def __init__(
        self,
        path: str | Path,
        *,
        poses: bool = True,
        poll_s: float | int = 0.1,
        idle_s: float | int = 10.0,
        patience_s: float | int = 3.0,
        stop_file: str = "stop",
        wait: Callable[[float | int], Any] | None = None,
    ):
        self.root = Path(path).expanduser()
        if not self.root.is_dir():
            raise SequenceNotFoundError(
                f"{self.root} is not a folder; expected one in which a recording is being written"
            )
        self.name, self.has_poses = given_name(self.root), poses
        self._poll_s, self._idle_s, self._patience_s = poll_s, idle_s, patience_s
        self._stop_file = self.root / stop_file
        self._stopping = threading.Event()
        self._wait = wait or self._stopping.wait
        self._poses = PosesOfImages(self.root / "poses.txt")
        self._values: dict[str, Any] = {}
        self._known: set[str] = set()
        self._waiting: dict[str, _Waiting] = {}
        self._depth: dict[str, Path] = {}
        self._late: list[Path] = []
        self._last: Any = None
        self._count = 0
        self._ending = False
        self._idled_s = self._head_s = 0.0

    def __iter__(self) -> "GrowingFolder":
        return self

    def __next__(self) -> Frame:
        while not self._stopping.is_set():
            if self._late:
                late = self._late.pop()
                raise BadFrameError(
                    f"{late} appeared after later frames were taken; expected files in order of their names"
                )
            head = next(iter(self._waiting), None)
            if head is not None and self._values:
                reason = self._lacks(head)
                if not reason:
                    return self._take(head)
                if self._ending or (self._head_s > self._patience_s and self._may_skip(head)):
                    self._leave(head)
                    raise BadFrameError(f"{reason}; the frame is left out")
            elif self._ending:
                self._tell_lone_depth()
                break
            self._round()
        if not self._values and not self._stopping.is_set():
            read_intrinsics(self.root / "intrinsics.json")  # raises an error that describes the damage
        raise StopIteration

    def _tell_lone_depth(self) -> None:
        """Raise ``BadFrameError`` for the next depth image without a colour image, which was deleted or never came."""
        for path in sorted(self._files("depth"), key=natural_order):
            if path.stem not in self._known:
                self._known.add(path.stem)
                raise BadFrameError(f"{self.root / 'rgb'} has no image {path.stem} for {path}; the frame is left out")

    def stop(self) -> None:
        """End the iteration immediately."""
        self._stopping.set()

    def _round(self) -> None:
        """Check the folder repeatedly until something is new or the recording has ended."""
        if self._look():
            self._idled_s = 0.0
            if self._waiting and self._values and not self._lacks(next(iter(self._waiting))):
                return
        self._ending = self._stop_file.exists() or self._idled_s >= self._idle_s
        if self._ending:  # files that were written before the end was declared
            self._look(final=True)
            return
        self._wait(self._poll_s)
        self._idled_s += self._poll_s
        self._head_s += self._poll_s

    def _look(self, *, final: bool = False) -> bool:
        """Update the known files; returns whether anything was new."""
        if not self._values:
            try:
                self._values = read_intrinsics(self.root / "intrinsics.json")
            except SequenceError:
                self._values = {}
            self._poses.first_image = self._values.get("first_image")
        changed = self._list()
        changed |= self.has_poses and self._poses.update(final=final)
        for stem in list(self._waiting)[: None if final else _LOOK_AT]:
            changed |= self._measure(stem, final)
        return changed

    def _list(self) -> bool:
        """Find new names; returns whether there were any."""
        new = [p for p in self._files("rgb") if p.stem not in self._known]
        for path in sorted(new, key=natural_order):
            self._known.add(path.stem)
            if self._last is not None and natural_order(path) < self._last:
                self._late.append(path)
            else:
                self._waiting[path.stem] = _Waiting(path)
        order = sorted(self._waiting.items(), key=lambda item: natural_order(item[1].rgb))
        if new:
            self._waiting = dict(order)
        self._depth = {p.stem: p for p in self._files("depth") if p.stem in self._waiting}
        return bool(new)

    def _files(self, kind: str) -> list[Path]:
        try:
            names = os.listdir(self.root / kind)
        except OSError:
            return []
        return [self.root / kind / n for n in names if n.lower().endswith(_SUFFIXES[kind]) and not n.startswith(".")]

    def _measure(self, stem: str, final: bool) -> bool:
        """Check the sizes of a frame's files; returns whether they changed."""
        waiting = self._waiting[stem]
        depth = self._depth.get(stem)
        sizes = (_size(waiting.rgb), -1 if depth is None else _size(depth))
        changed = sizes != waiting.sizes
        waiting.settled = min(sizes) > 0 and (final or not changed)
        waiting.sizes = sizes
        return changed

    def _lacks(self, stem: str) -> str:
        """What is still missing of the frame, or an empty string."""
        waiting, depth = self._waiting[stem], self._depth.get(stem)
        if depth is None:
            return f"{self.root / 'depth'} has no image {stem} for {waiting.rgb}"
        if waiting.sizes[0] < 0:
            return f"{waiting.rgb} was deleted"
        if not waiting.settled:
            return f"{waiting.rgb} or {depth} is empty or still being written"
        for path in (waiting.rgb, depth):
            if not is_complete_image(path):
                return f"{path} is truncated; expected a whole image"
        try:
            lacks = self.has_poses and not self._poses.is_there(waiting.rgb)
        except BadFrameError as e:
            return str(e)
        return f"{self._poses.path} has no pose for {waiting.rgb}" if lacks else ""

    def _may_skip(self, stem: str) -> bool:
        """Whether later frames are there, and more than the pose is missing."""
        return len(self._waiting) > 1 and "has no pose" not in self._lacks(stem)

    def _take(self, stem: str) -> Frame:
        rgb, depth = self._waiting[stem].rgb, self._depth[stem]
        position = self._poses.position(rgb) if self.has_poses else None
        number = self._count if position is None else position
        self._leave(stem)
        T_WC, source = self._poses.take(rgb) if self.has_poses else (no_poses(1), "")
        file = self.root / "intrinsics.json"
        shift = 0.5 - self._values.get("pixel_centre", 0.0)
        one = RecordedSequence(
            name=self.name,
            camera=camera(self._values, CAMERA_KEYS, file, shift=shift),
            rgb_files=[rgb],
            depth_files=[depth],
            timestamps_s=[number / self._values.get("fps", 30.0)],
            poses=T_WC,
            pose_sources=[source],
            has_poses=self.has_poses,
            depth_scale=float(self._values["depth_scale"]),
            depth_invalid=(int(self._values.get("depth_invalid", 0)),),
        )
        return one[0]

    def _leave(self, stem: str) -> None:
        """Go on to the next frame."""
        rgb = self._waiting.pop(stem).rgb
        self._last = natural_order(rgb)
        self._poses.passed(rgb)
        self._depth.pop(stem, None)
        self._count += 1
        self._idled_s = self._head_s = 0.0


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return -1
