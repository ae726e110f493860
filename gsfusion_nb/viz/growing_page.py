"""A page that shows a run while it maps, as a file: the report takes its place in the end."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..drawing.page import fill, page_picture
from ..files import write_file
from ..types import Frame
from .map_from_above import map_from_above

EVERY_S = 2.0
"""Time between two states of the page, seconds; the browser loads it again as often."""
_ABOVE = (480, 360)


class GrowingPage:
    """Writes an HTML file with the newest photograph, the same view of the map, and the map from
    above: a watcher of runs.

    The page loads itself again. As a context manager it removes the page at the end, unless another
    one, such as a report, was written in its place.

    Args:
        path: The file, written at once, and atomically.
        title: Its heading.
    """

    def __init__(self, path: Path, title: str):
        self.path = path
        self.title = title
        self._next_s = 0.0
        self._text = ""
        self._write("No picture yet: programs are being compiled, once on a machine.", ())

    def frame_mapped(self, mapper: Any, frame: Frame, report: Any) -> None:
        """Called by the run after each frame."""
        if time.monotonic() < self._next_s:
            return
        poses = mapper.trajectory.poses
        pictures = [
            page_picture(frame.rgb_u8, "What the camera sees"),
            page_picture(
                mapper.render(frame.camera, poses[-1]).rgb.clamp(0, 1).cpu(), "The map, seen so"
            ),
        ]
        if not mapper.description.needs_volume_to_render:
            above = map_from_above(mapper.parts.params_now(), [], poses, _ABOVE)
            pictures.append(page_picture(above, "The map from above, with the camera's way"))
        words = f"{mapper.description.title}, frame {mapper.n_frames}: {report.in_words}"
        self._write(words, pictures)
        self._next_s = time.monotonic() + EVERY_S

    def finished(self, mapper: Any, mesh: Any, metrics: dict[str, Any]) -> None:
        """Called by the run at its end."""
        self._write(f"{mapper.description.title} is finished.", ())

    def __enter__(self) -> "GrowingPage":
        return self

    def __exit__(self, *_: Any) -> None:
        if self.path.is_file() and self.path.read_text(encoding="utf-8") == self._text:
            self.path.unlink()

    def _write(self, words: str, pictures: Sequence[dict[str, Any]]) -> None:
        self._text = fill(
            "growing.html",
            title=self.title,
            words=words,
            pictures=pictures,
            every_s=round(EVERY_S),
        )
        write_file(self.path, self._text)
