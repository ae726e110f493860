"""A folder in the plain layout, read while another program writes it."""

import contextlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ...checks import shown
from ...errors import BadFrameError, SequenceError, SequenceNotFoundError
from ...files import read_text
from ...types import Frame
from ..readers.folder import read_intrinsics, recording_of
from ..recorded.files import given_name, natural_order
from ..recorded.images import is_complete_image
from ..recorded.poses import image_key, image_number, no_poses, parsed_pose, split_name
from .frame_queue import LiveSource, Policy

_SUFFIXES = {"rgb": (".jpg", ".jpeg", ".png"), "depth": (".png",)}


class GrowingFolder(LiveSource):
    """Frames of a folder in the plain layout (``gsfusion_nb.data.readers.folder``) as they are
    written.

    A frame counts when both its images end as PNG and JPEG files do, and, unless the camera is to
    be tracked, its line of ``poses.txt`` is written. A line "name r00 r01 ... r33" belongs to the
    image of that name; lines of numbers alone belong to images by the number in their names, from 0
    on, so that a missing image does not shift the poses. Frames come in natural order of their
    names. One whose images stay incomplete for ``patience_s`` while later ones are there raises
    ``BadFrameError``, and so does a later file that sorts before the frames already taken; poses
    are waited for.

    The iteration ends after the last frame when a file named ``stop_file`` is in the folder or
    nothing new has come for ``idle_s``, or immediately with ``stop``.

    Args:
        path: The folder; it may still be empty, but must exist.
        poses: False: there is no ``poses.txt``; the camera must be tracked.
        poll_s: Time between two rounds, seconds.
        idle_s: End after this time without anything new, seconds.
        patience_s: Skip an incomplete frame after this time, seconds.
        stop_file: Name of the file that ends the recording.
        wait: Function that waits for a number of seconds; for tests.

    Raises:
        SequenceNotFoundError: no such folder. SequenceError, while iterating: it is not clear which
            line of ``poses.txt`` belongs to an image.
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
        self.name = given_name(self.root)
        self.has_poses = poses
        self._poll_s = poll_s
        self._idle_s = idle_s
        self._patience_s = patience_s
        self._stop_file = self.root / stop_file
        self._poses_file = self.root / "poses.txt"
        self._stopping = threading.Event()
        self._wait = wait or self._stopping.wait
        self._values: dict[str, Any] = {}
        self._waiting: list[Path] = []
        """Colour images that were neither taken nor left out, in order."""
        self._depth: dict[str, Path] = {}
        self._done: set[str] = set()
        self._last: Any = None
        self._pose_chars = 0
        self._lines = []
        self._line_of_name: dict[str, str] = {}
        self._ending = False
        self._idled_s = self._head_s = 0.0

    def __iter__(self) -> "GrowingFolder":
        return self

    def __next__(self) -> Frame:
        while not self._stopping.is_set():
            if self._waiting and self._values:
                head = self._waiting[0]
                if self._last is not None and natural_order(head) < self._last:
                    self._done.add(head.stem)
                    self._waiting.pop(0)
                    raise BadFrameError(
                        f"{head} came after later frames were taken; expected files in order of "
                        "their names"
                    )
                lacks = self._lacks_image(head)
                if not lacks and (line := self._line(head)) is not None:
                    return self._take(head, line)
                if self._ending or (
                    lacks and len(self._waiting) > 1 and self._head_s > self._patience_s
                ):
                    self._leave(head)
                    raise BadFrameError(
                        f"{lacks or f'{self._poses_file} has no pose for {head}'}; it is left out"
                    )
            elif self._ending:
                break
            self._round()
        if not self._values and not self._stopping.is_set():
            # raises an error that describes the damage
            read_intrinsics(self.root / "intrinsics.json")
        raise StopIteration

    def stop(self) -> None:
        """End the iteration immediately."""
        self._stopping.set()

    def _round(self) -> None:
        """Look for what is new; if there is nothing, wait, or find that the recording has ended."""
        if self._look():
            self._idled_s = 0.0
            return
        self._ending = self._stop_file.exists() or self._idled_s >= self._idle_s
        if self._ending:  # files that were written before the end was declared
            self._look(final=True)
            return
        self._wait(self._poll_s)
        self._idled_s += self._poll_s
        self._head_s += self._poll_s

    def _look(self, *, final: bool = False) -> bool:
        """Update what is known of the folder; returns whether there are new images or poses."""
        if not self._values:
            with contextlib.suppress(SequenceError):
                self._values = read_intrinsics(self.root / "intrinsics.json")
        waiting = self._waiting
        self._waiting = sorted(
            (p for p in self._files("rgb") if p.stem not in self._done), key=natural_order
        )
        self._depth = {p.stem: p for p in self._files("depth") if p.stem not in self._done}
        return (self.has_poses and self._read_poses(final)) or self._waiting != waiting

    def _files(self, kind: str) -> list[Path]:
        folder = self.root / kind
        entries = folder.iterdir() if folder.is_dir() else ()
        return [
            p for p in entries if p.suffix.lower() in _SUFFIXES[kind] and not p.name.startswith(".")
        ]

    def _read_poses(self, final: bool) -> bool:
        """Read the lines of ``poses.txt`` that have their end, and ``final`` the last one, too."""
        try:
            text = read_text(self._poses_file, "lines of poses")
        except SequenceError:
            return False
        if len(text) == self._pose_chars and not final:
            return False
        self._pose_chars = len(text)
        lines = (line.strip() for line in (text.split("\n") if final else text.split("\n")[:-1]))
        self._lines = [line for line in lines if line and not line.startswith("#")]
        names_and_lines = ((split_name(line)[0], line) for line in self._lines)
        self._line_of_name = {
            image_key(name): line for name, line in names_and_lines if name is not None
        }
        return True

    def _lacks_image(self, image: Path) -> str:
        """Which image of the frame is not there or not complete, or an empty string."""
        depth = self._depth.get(image.stem)
        if depth is None:
            return f"{self.root / 'depth'} has no image {image.stem} for {image}"
        incomplete = next((path for path in (image, depth) if not is_complete_image(path)), None)
        return f"{incomplete} is truncated; expected a whole image" if incomplete else ""

    def _line(self, image: Path) -> str | None:
        """The pose of an image as it is written, empty if there are no poses; None if it is not
        there yet."""
        if not self.has_poses:
            return ""
        if self._line_of_name:
            return self._line_of_name.get(image_key(image.stem))
        if not self._lines:
            return None
        number = self._number(image)
        return self._lines[number] if 0 <= number < len(self._lines) else None

    def _number(self, image: Path) -> int:
        """Which line without a name is the image's, from 0."""
        number = image_number(image)
        if number is None or (number != 0 and not self._done):
            raise SequenceError(
                f"it is not clear which line of {self._poses_file} belongs to {image}; begin each "
                "line with the name of its image"
            )
        return number

    def _take(self, image: Path, line: str) -> Frame:
        by_number = self.has_poses and not self._line_of_name
        at = self._number(image) if by_number else len(self._done)
        depth = self._depth[image.stem]
        self._leave(image)
        source = f"{self._poses_file} pose {at if by_number else f'of {image.stem}'}"
        one = recording_of(
            self.root,
            self._values,
            rgb_files=[image],
            depth_files=[depth],
            timestamps_s=[at / self._values.get("fps", 30.0)],
            poses=_pose(line, source) if self.has_poses else no_poses(1),
            pose_sources=[source],
            has_poses=self.has_poses,
        )
        return one[0]

    def _leave(self, image: Path) -> None:
        """Go on to the next frame."""
        self._waiting.remove(image)
        self._done.add(image.stem)
        self._last = natural_order(image)
        self._idled_s = self._head_s = 0.0


def _pose(line: str, source: str) -> Float[Tensor, "1 4 4"]:
    try:
        return parsed_pose(split_name(line)[1]).reshape(1, 4, 4)
    except ValueError:
        raise BadFrameError(f"{source} must be 16 row-major numbers, got {shown(line)}") from None
