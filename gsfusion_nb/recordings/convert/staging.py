"""The folder that a conversion writes: beside its final place until it is complete, and resumable."""

import dataclasses
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...data.sequence import BadFrameError, SequenceError
from ...files import move_into_place, write_file
from ...foreign import parse_json, read_object, read_text
from ...types import Camera

JPEG_QUALITY = 95
_JOURNAL = "frames.jsonl"
_PLAN = "plan.json"
_CAMERA = "camera.json"
_VERSION = 2
"""Of the partial folder."""


@dataclass(frozen=True)
class JournalEntry:
    """The result for one frame."""

    position: int
    """Position in the recording."""
    dropped: str = ""
    """Reason why it was left out, or empty."""
    time_s: float | None = None
    T_WC: tuple[float, ...] = ()
    detail: str = ""
    """The error of a dropped frame."""
    far_pixels: int = 0
    """Pixels that are farther than 16 bits hold."""
    files: tuple[Any, ...] = ()
    """Suffix and size of the colour file and size of the depth file of a kept frame, bytes."""


class Staging:
    """Collects a conversion beside its final place, and puts everything there at once.

    ``OUT.partial`` holds the plan, the camera, a journal with one line per frame, and ``sequence``, which becomes
    ``OUT``. After a program was killed, the same conversion can be called again and continues: the plan is written
    first and removed last, a line is written after its images, and the images of the last line are checked and, if
    damaged, made again.
    """

    def __init__(self, out: Path, plan: dict[str, Any]):
        """Start, or continue an interrupted conversion.

        Args:
            out: Final folder; must not exist, or be empty, unless a killed conversion has just put it there.
            plan: What is converted and how; a partial folder of another plan is refused.
        """
        self.out = out
        self.folder = out.with_name(f"{out.name}.partial")
        self.sequence = self.folder / "sequence"
        self.rows: list[JournalEntry] = []
        self._text = json.dumps({"version": _VERSION, **plan}, sort_keys=True, indent=1)
        self.finished: dict[str, Any] | None = None
        """The report of this conversion, where it was killed after its result was put in place."""
        if self._is_in_place():
            self.finished = read_object(out / "conversion.json", "the report of a conversion")
            self._clean_up()
            return
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise SequenceError(f"{out} already exists; expected the name of a new or empty folder to write to")
        self.rows = self._open()
        self.resumed = len(self.rows)
        """Shots that an earlier, interrupted conversion has dealt with."""

    @property
    def kept(self) -> list[JournalEntry]:
        """Rows of the frames that were written, in order."""
        return [r for r in self.rows if not r.dropped]

    @property
    def camera(self) -> Camera | None:
        """Camera chosen by an earlier, interrupted conversion; None before the first frame."""
        file = self.folder / _CAMERA
        return Camera(**read_object(file, "a camera")) if file.exists() else None

    def set_camera(self, camera: Camera) -> None:
        """Store the camera of all frames, for a later continuation."""
        write_file(self.folder / _CAMERA, json.dumps(vars(camera)))

    def remove(self) -> None:
        """Remove the folder of a conversion that wrote nothing."""
        if not self.kept:
            self._clean_up()

    def drop(self, position: int, reason: str, detail: str = "") -> None:
        """Record that a frame is left out."""
        self._append(JournalEntry(position, reason, detail=detail))

    def write(self, row: JournalEntry, rgb: np.ndarray | bytes, depth: np.ndarray, *, lossless: bool = True) -> None:
        """Write colour and 16-bit depth, then the journal's line.

        Args:
            row: The line.
            rgb: A JPEG or PNG file, which is written unchanged, or RGB, uint8. [H, W, 3]
            depth: Stored depth, uint16. [H, W]
            lossless: Write RGB as PNG; otherwise as JPEG, for images that were JPEG before they were resampled.
        """
        import cv2

        name = f"{len(self.kept):06d}"
        if isinstance(rgb, bytes):
            suffix, data = (".png" if rgb[:4] == b"\x89PNG" else ".jpg"), rgb
        else:
            suffix = ".png" if lossless else ".jpg"
            full_colour = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
            options = [] if lossless else [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, *full_colour]
            data = _encoded(suffix, rgb[..., ::-1], options)
        packed_depth = _encoded(".png", depth, [])
        (self.sequence / "rgb" / f"{name}{suffix}").write_bytes(data)
        (self.sequence / "depth" / f"{name}.png").write_bytes(packed_depth)
        self._append(dataclasses.replace(row, files=(suffix, len(data), len(packed_depth))))

    def forget_times(self) -> None:
        """Write no times: those of the recording are not times."""
        self.rows = [dataclasses.replace(row, time_s=None) for row in self.rows]

    def finish(self, camera: Camera, settings: dict[str, Any], report: dict[str, Any]) -> None:
        """Write intrinsics, poses, times and the report, and move everything to its final place."""
        intrinsics = {
            **{k: getattr(camera, k) for k in ("width", "height", "fx", "fy", "cx", "cy")},
            "pixel_centre": 0.5,
            "pose_convention": "camera-to-world, OpenCV axes, metres",
            **settings,
        }
        if all(r.T_WC for r in self.kept):
            lines = [" ".join(repr(v) for v in r.T_WC) for r in self.kept]
            (self.sequence / "poses.txt").write_text("\n".join([*lines, ""]))
        times = [
            "frame time_s",
            *(f"{i:06d} {'nan' if r.time_s is None else repr(r.time_s)}" for i, r in enumerate(self.kept)),
        ]
        (self.sequence / "times.txt").write_text("\n".join([*times, ""]))
        (self.sequence / "conversion.json").write_text(json.dumps(report, indent=1))
        (self.sequence / "intrinsics.json").write_text(json.dumps(intrinsics, indent=1))
        self._remove_strays()
        if self.out.exists():
            self.out.rmdir()
        move_into_place(self.sequence, self.out)
        self._clean_up()

    def _is_in_place(self) -> bool:
        """A conversion of this plan was killed after its result was put in place."""
        begun = any((self.folder / name).exists() for name in (_JOURNAL, _PLAN))
        in_place = (self.out / "conversion.json").is_file() and not self.sequence.exists()
        return in_place and self.folder.is_dir() and (self._is_of_this_plan() or not begun)

    def _is_of_this_plan(self) -> bool:
        file = self.folder / _PLAN
        return file.is_file() and read_text(file, "the plan of a conversion") == self._text

    def _open(self) -> list[JournalEntry]:
        journal, plan = self.folder / _JOURNAL, self.folder / _PLAN
        begun = plan.exists() or journal.exists() or self.sequence.exists()
        if begun and not self._is_of_this_plan():
            raise SequenceError(
                f"{self.folder} holds an unfinished conversion of another source or with other options; delete it, "
                "or repeat the options to continue"
            )
        if not begun:
            write_file(plan, self._text)
        for name in ("rgb", "depth"):
            (self.sequence / name).mkdir(parents=True, exist_ok=True)
        return self._read_journal()

    def _read_journal(self) -> list[JournalEntry]:
        """Rows whose line and images are whole; the journal is cut after them, and its end is made again."""
        journal = self.folder / _JOURNAL
        text = read_text(journal, "the journal of a conversion") if journal.exists() else ""
        rows: list[JournalEntry] = []
        n_kept, end = 0, 0
        for line in text.splitlines(keepends=True):
            row = _row(line)
            if row is None or not self._has_pictures(row, n_kept):
                break
            rows.append(row)
            n_kept += not row.dropped
            end += len(line)
        if end != len(text):
            write_file(journal, text[:end])
        return rows

    def _has_pictures(self, row: JournalEntry, number: int) -> bool:
        """The images of a kept row have the bytes that were written; a system that lost power may lack some."""
        if row.dropped:
            return True
        suffix, *sizes = row.files
        files = (self.sequence / f"rgb/{number:06d}{suffix}", self.sequence / f"depth/{number:06d}.png")
        return all(f.is_file() and f.stat().st_size == size for f, size in zip(files, sizes, strict=True))

    def _remove_strays(self) -> None:
        """Remove images of a frame that was written before a kill and came out with another suffix after it."""
        names = {f"{i:06d}{row.files[0]}" for i, row in enumerate(self.kept)}
        for file in (self.sequence / "rgb").iterdir():
            if file.name not in names:
                file.unlink()

    def _append(self, row: JournalEntry) -> None:
        with (self.folder / _JOURNAL).open("a") as file:
            file.write(json.dumps(vars(row)) + "\n")
        self.rows.append(row)

    def _clean_up(self) -> None:
        """Remove the partial folder, its plan last, so that a kill in between leaves one that is known."""
        if self.sequence.exists():
            shutil.rmtree(self.sequence)
        for name in (_JOURNAL, _CAMERA, _PLAN):
            (self.folder / name).unlink(missing_ok=True)
        shutil.rmtree(self.folder, ignore_errors=True)


def _row(line: str) -> JournalEntry | None:
    """The row of a whole line of the journal; None for one that was cut short."""
    try:
        values = parse_json(line, "the journal", "a row") if line.endswith("\n") else {}
        row = JournalEntry(**{**values, "T_WC": tuple(values["T_WC"]), "files": tuple(values["files"])})
        return row if row.dropped or len(row.files) == 3 else None
    except (SequenceError, TypeError, KeyError):
        return None


def _encoded(suffix: str, image: np.ndarray, options: list[int]) -> bytes:
    import cv2

    done, data = cv2.imencode(suffix, np.ascontiguousarray(image), options)
    if not done:
        raise BadFrameError(f"an image of {image.shape[1]}x{image.shape[0]} cannot be written as {suffix}")
    return data.tobytes()
