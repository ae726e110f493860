"""A folder in the plain layout, read while another program writes it."""

import logging
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ...checks import shown
from ...files import TEXT_BYTES, open_regular
from ...types import Frame
from ..readers.folder import CAMERA_KEYS, read_intrinsics
from ..recorded.files import camera, given_name, natural_order
from ..recorded.images import is_complete_image
from ..recorded.poses import image_key, image_number, no_poses, parsed_pose, split_name
from ..recorded.recorded_sequence import RecordedSequence
from ..sequence import BadFrameError, SequenceError, SequenceNotFoundError
from .frame_queue import LiveSource, Policy

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


class PosesOfImages:
    """The lines of a growing poses.txt, each bound to the image that it is written for.

    A line "name r00 r01 ... r33" belongs to the image of that name. Lines of numbers alone belong to images by the
    number at the end of their names: the first line to the image with the number ``first_image``, and so on; a missing
    image leaves its line unused. Empty lines and ``#`` comments do not count; a line counts when its end is written.

    Args:
        path: The file; it may not exist yet.
    """

    def __init__(self, path: Path):
        self.path = path
        self.first_image: int | None = None
        """Number in the name of the image that the first line belongs to; ``None``: 0, and the image must be there."""
        self._lines: list[str] = []
        self._of_name: dict[str, str] = {}
        self._read_bytes, self._rest = 0, b""
        self._first_seen: int | None = None
        self._last = -1
        """Line of the last image that was passed."""

    def update(self, *, final: bool = False) -> bool:
        """Read what was appended; ``final`` counts a last line without an end. Whether anything was new.

        A file that has become shorter was written anew; it is read from its beginning.
        """
        try:
            if self.path.stat().st_size < self._read_bytes:
                self._read_bytes, self._rest = 0, b""
                self._lines.clear()
            with open_regular(self.path, "lines of text") as file:
                file.seek(self._read_bytes)
                new = file.read(TEXT_BYTES)
        except (OSError, SequenceError):
            return False
        self._read_bytes += len(new)
        *whole, self._rest = (self._rest + new).split(b"\n")
        if final and self._rest:
            whole, self._rest = [*whole, self._rest], b""
        for line in (text.decode("utf-8-sig", errors="replace").strip() for text in whole):
            if line and not line.startswith("#"):
                self._lines.append(line)
                self._of_name[image_key(split_name(line)[0] or line.split()[0])] = line
        return bool(new)

    def is_there(self, image: Path) -> bool:
        """The line of an image is written.

        Raises:
            SequenceError: the lines have no names, and the image's name does not tell its line.
            BadFrameError: the same line belongs to an image before it.
        """
        number = self.position(image)
        if number is not None and number <= self._last:
            raise BadFrameError(f"{image} has the same number as an image before it; expected a number of its own")
        return self._line(image) is not None

    def passed(self, image: Path) -> None:
        """An image was taken, or left out."""
        number = image_number(image)
        if number is not None:
            self._first_seen = number if self._first_seen is None else self._first_seen
            self._last = max(self._last, number - (self.first_image or 0))

    def take(self, image: Path) -> tuple[Float[Tensor, "1 4 4"], str]:
        """The pose of an image, not yet checked, and where it is written.

        Raises:
            BadFrameError: the line is not 16 numbers.
        """
        number, line = self.position(image), self._line(image)
        source = f"{self.path} pose {f'of {image.stem}' if number is None else number}"
        assert line is not None
        try:
            return parsed_pose(split_name(line)[1]).reshape(1, 4, 4), source
        except ValueError:
            raise BadFrameError(f"{source} must be 16 row-major numbers, got {shown(line)}") from None

    def position(self, image: Path) -> int | None:
        """Which line is the image's by its number, from 0; ``None`` where lines have names, or there are none yet."""
        if not self._lines or split_name(self._lines[0])[0] is not None:
            return None
        number = image_number(image)
        first = number if self._first_seen is None else self._first_seen
        if number is None or (self.first_image is None and first != 0):
            raise SequenceError(
                f"it is not clear which line of {self.path} belongs to {image}: expected images numbered from 0 "
                "(000000.jpg, 000001.jpg, ...), or the number of the first line's image as first_image in "
                "intrinsics.json, or each line to begin with the name of its image"
            )
        return number - (self.first_image or 0)

    def _line(self, image: Path) -> str | None:
        number = self.position(image)
        if number is None:
            return self._of_name.get(image_key(image.stem))
        return self._lines[number] if 0 <= number < len(self._lines) else None
