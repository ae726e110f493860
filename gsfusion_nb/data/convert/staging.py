"""The folder that a conversion writes: beside its final place until it is complete, and resumable."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...files import move_into_place, write_file
from ...types import Camera
from ..sequence import BadFrameError, SequenceError

JPEG_QUALITY = 95
_JOURNAL = "frames.jsonl"
_PLAN = "plan.json"
_CAMERA = "camera.json"


@dataclass(frozen=True)
class JournalEntry:
    """What became of one shot."""

    shot: int
    """Position in the recording."""
    dropped: str = ""
    """Reason why it was left out, or empty."""
    time_s: float | None = None
    T_WC: tuple[float, ...] = ()
    detail: str = ""
    """The error of a dropped shot."""


class Staging:
    """Writes pictures to ``OUT.partial``; ``finish`` puts everything in place at once.

    A journal gets one line per shot after its pictures are on disk, so an interrupted conversion continues after the
    last complete one. The folder reader refuses ``OUT.partial``: the poses and intrinsics are written last.
    """

    def __init__(self, out: Path, plan: dict[str, Any]):
        """Start, or continue an interrupted conversion.

        Args:
            out: Final folder; must not exist, or be empty.
            plan: What is converted and how; a partial folder of another plan is refused.
        """
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise SequenceError(f"{out} already exists; expected the name of a new or empty folder to write to")
        self.out = out
        self.folder = out.with_name(f"{out.name}.partial")
        self.rows = self._open(plan)
        self.resumed = len(self.rows)

    @property
    def kept(self) -> list[JournalEntry]:
        """Rows of the frames that were written, in order."""
        return [r for r in self.rows if not r.dropped]

    @property
    def camera(self) -> Camera | None:
        """Camera that an earlier, interrupted conversion chose; None before the first frame."""
        file = self.folder / _CAMERA
        return Camera(**json.loads(file.read_text())) if file.exists() else None

    def set_camera(self, camera: Camera) -> None:
        """Keep the camera of all frames, to continue later."""
        write_file(self.folder / _CAMERA, json.dumps(vars(camera)))

    def remove(self) -> None:
        """Remove the folder of a conversion that wrote nothing."""
        if not self.kept:
            shutil.rmtree(self.folder)

    def drop(self, shot: int, reason: str, detail: str = "") -> None:
        """Note that a shot is left out."""
        self._append(JournalEntry(shot, reason, detail=detail))

    def write(self, row: JournalEntry, rgb: np.ndarray | bytes, depth: np.ndarray, *, lossless: bool = True) -> None:
        """Write colour and 16-bit depth, then the journal's line.

        Args:
            row: The line.
            rgb: A JPEG or PNG file, which is written as it is, or RGB, uint8. [H, W, 3]
            depth: Stored depth, uint16. [H, W]
            lossless: RGB becomes PNG, else JPEG, for what was JPEG before it was resampled.
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
        (self.folder / "rgb" / f"{name}{suffix}").write_bytes(data)
        (self.folder / "depth" / f"{name}.png").write_bytes(_encoded(".png", depth, []))
        self._append(row)

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
            (self.folder / "poses.txt").write_text("\n".join([*lines, ""]))
        times = [
            "frame time_s",
            *(f"{i:06d} {'nan' if r.time_s is None else repr(r.time_s)}" for i, r in enumerate(self.kept)),
        ]
        (self.folder / "times.txt").write_text("\n".join([*times, ""]))
        (self.folder / "conversion.json").write_text(json.dumps(report, indent=1))
        for name in (_JOURNAL, _PLAN, _CAMERA):
            (self.folder / name).unlink()
        (self.folder / "intrinsics.json").write_text(json.dumps(intrinsics, indent=1))
        if self.out.exists():
            self.out.rmdir()
        move_into_place(self.folder, self.out)

    def _open(self, plan: dict[str, Any]) -> list[JournalEntry]:
        file = self.folder / _PLAN
        text = json.dumps(plan, sort_keys=True, indent=1)
        if self.folder.exists():
            if not file.is_file() or file.read_text() != text:
                raise SequenceError(
                    f"{self.folder} holds an unfinished conversion of something else or with other options; delete it, "
                    "or repeat the options to continue"
                )
            return self._read_journal()
        for name in ("rgb", "depth"):
            (self.folder / name).mkdir(parents=True)
        file.write_text(text)
        return []

    def _read_journal(self) -> list[JournalEntry]:
        """Rows whose line is whole; a line that was cut short is forgotten, with its pictures."""
        journal = self.folder / _JOURNAL
        text = journal.read_text() if journal.exists() else ""
        whole = text[: text.rfind("\n") + 1]
        if whole != text:
            journal.write_text(whole)
        rows = []
        for line in whole.splitlines():
            values = json.loads(line)
            rows.append(JournalEntry(**{**values, "T_WC": tuple(values["T_WC"])}))
        return rows

    def _append(self, row: JournalEntry) -> None:
        with (self.folder / _JOURNAL).open("a") as file:
            file.write(json.dumps(vars(row)) + "\n")
        self.rows.append(row)


def _encoded(suffix: str, image: np.ndarray, options: list[int]) -> bytes:
    import cv2

    done, data = cv2.imencode(suffix, np.ascontiguousarray(image), options)
    if not done:
        raise BadFrameError(f"a picture of {image.shape[1]}x{image.shape[0]} cannot be written as {suffix}")
    return data.tobytes()
