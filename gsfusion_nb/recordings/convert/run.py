"""Converting a recording into the plain ``folder`` layout, one frame at a time."""

import dataclasses
import itertools
import statistics
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...data.lens.camera_model import CameraModel
from ...data.recorded.stamps import Stamps, judge_stamps
from ...data.sequence import BadFrameError, SequenceError
from ...types import Camera
from ...work import ProgressDisplay
from .detect import FORMATS, detect_format
from .frame_poses import FramePoses
from .intrinsics import read_intrinsics
from .options import ConvertOptions
from .recording import RecordedFrame, Recording, RgbdImages
from .rectify import Rectifier, output_camera
from .staging import JournalEntry, Staging

MILLIMETRES = 1000.0
_FINEST, _COARSEST = 20000.0, 200.0
"""Depth scales of a recording that are kept; others (metres, floating point) are written in millimetres."""


@dataclass(frozen=True, kw_only=True)
class ConvertReport:
    """What a conversion did."""

    out: Path
    format: str
    frames_read: int
    """Frames read: those of the recording, or every n-th of them."""
    frames: int
    """Frames written."""
    dropped: dict[str, int]
    """Frames left out, by reason."""
    examples: tuple[str, ...]
    """The first errors of dropped frames."""
    camera: Camera
    depth_scale: float
    has_poses: bool
    notes: tuple[str, ...]

    @staticmethod
    def of_document(document: dict[str, Any]) -> "ConvertReport":
        """From ``conversion.json``."""
        values: dict[str, Any] = {f.name: document[f.name] for f in dataclasses.fields(ConvertReport)}
        values |= {name: tuple(values[name]) for name in ("examples", "notes")}
        return ConvertReport(**values | {"out": Path(values["out"]), "camera": Camera(**values["camera"])})

    def __str__(self) -> str:
        c = self.camera
        lines = [
            f"{self.frames} of {self.frames_read} frames ({self.format}) in {self.out}",
            f"  camera {c.width}x{c.height}, fx {c.fx:.2f} fy {c.fy:.2f} cx {c.cx:.2f} cy {c.cy:.2f}, pixel centre 0.5",
            f"  depth in 16-bit PNG, {self.depth_scale:g} per metre, 0 = missing; "
            + ("poses camera-to-world in metres" if self.has_poses else "no poses"),
            *(f"  left out {n}: {reason}" for reason, n in self.dropped.items()),
            *(f"    {example}" for example in self.examples),
            *(f"  note: {note}" for note in self.notes),
            f"Next: gsfusion-nb check {self.out}{'' if self.has_poses else ' --reader poses=false'}",
        ]
        return "\n".join(lines)


def convert(
    source: str | Path,
    out: str | Path,
    *,
    format: str = "auto",
    options: ConvertOptions | None = None,
    progress: bool = False,
) -> ConvertReport:
    """Write a recording in another format as a ``folder`` sequence (``gsfusion_nb.data.readers.folder``).

    Frames are read and written one by one. They are collected in ``OUT.partial`` and appear as ``OUT`` when all is
    done; an interrupted conversion continues where it stopped when it is called again. Colour images that need no
    change are copied. Frames without pose, with damaged images or without depth are left out and counted.

    Args:
        source: File or folder of the recording.
        out: New or empty folder.
        format: One of ``known_formats()``; "auto" recognises it.
        options: Options of reading and writing.
        progress: Show a progress bar.

    Raises:
        SequenceError: the recording cannot be read, needs an option that is not given, or no frame of it is usable.
        KeyError: unknown format.
    """
    options = options or ConvertOptions()
    path = Path(source).expanduser()
    name = detect_format(path) if format == "auto" else format
    if name not in FORMATS:
        raise KeyError(f"no format {name!r}; known: {', '.join(FORMATS)}")
    recording = FORMATS[name].read(path, options)
    poses = FramePoses(recording, options)
    plan = {"format": name, "source": str(path.resolve()), "options": dataclasses.asdict(options)}
    staging = Staging(Path(out), plan)
    if staging.finished is not None:
        return ConvertReport.of_document(staging.finished)
    try:
        conversion = _Conversion(recording, options, poses, staging)
        conversion.run(progress)
        return conversion.finish(name)
    except KeyboardInterrupt as e:
        e.add_note(f"{len(staging.kept)} frames are in {staging.folder}; repeat the command to continue")
        raise
    except BaseException:
        staging.remove()
        raise


def _time_note(stamps: Stamps) -> list[str]:
    why = stamps.why_not
    return [f"the recorded times are not times: {why}; no times or frame rate are written"] if why else []


class _Conversion:
    """One pass over the frames of a recording."""

    def __init__(self, recording: Recording, options: ConvertOptions, poses: FramePoses, staging: Staging):
        self._recording, self._options, self._poses, self._staging = recording, options, poses, staging
        scale = options.depth_scale or recording.depth_scale
        self.depth_scale = scale if _COARSEST <= scale <= _FINEST else MILLIMETRES
        along = options.depth_along
        self._along_ray = recording.depth_along_ray if along == "auto" else along == "ray"
        self._rectifier: Rectifier | None = None
        if staging.camera is not None:
            self._rectifier = Rectifier(staging.camera, along_ray=self._along_ray)

    def run(self, progress: bool) -> None:
        """Convert the frames that are not in the journal yet."""
        with ProgressDisplay("converting", total=self._recording.n_frames, unit="frame", shown=progress) as shown:
            for i, frame in enumerate(shown.over(self._recording.frames())):
                if i % self._options.every == 0 and i // self._options.every >= self._staging.resumed:
                    self._convert(i, frame)

    def finish(self, format: str) -> ConvertReport:
        """Put the result in place and report on it."""
        rows, kept = self._staging.rows, self._staging.kept
        dropped = dict(Counter(self._recording.dropped) + Counter(r.dropped for r in rows if r.dropped))
        examples = [r.detail for r in rows if r.detail]
        if not kept or self._rectifier is None:
            told = "; ".join([*(f"{n} left out: {reason}" for reason, n in dropped.items()), *examples[:1]])
            hint = self._time_hint(rows)
            raise SequenceError(
                f"{self._recording.name}: no frame can be used ({told or 'it has none'}){hint}; expected at least one"
            )
        times = [r.time_s for r in kept if r.time_s is not None]
        stamps = judge_stamps(times, unit="s")
        if stamps.times_s is None:
            self._staging.forget_times()
        steps = [b - a for a, b in itertools.pairwise(stamps.times_s or []) if b > a]
        report = ConvertReport(
            out=self._staging.out,
            format=format,
            frames_read=len(rows),
            frames=len(kept),
            dropped=dropped,
            examples=tuple(examples[:3]),
            camera=self._rectifier.camera,
            depth_scale=self.depth_scale,
            has_poses=not self._poses.none,
            notes=(*self._recording.notes, *self._poses.notes, *self._far_note(), *_time_note(stamps)),
        )
        settings: dict[str, Any] = {"depth_scale": self.depth_scale}
        if steps:
            settings["fps"] = 1.0 / statistics.median(steps)
        written = {**dataclasses.asdict(report), "out": str(report.out), "source": self._recording.name}
        self._staging.finish(report.camera, settings, written)
        return report

    def _convert(self, i: int, frame: RecordedFrame) -> None:
        try:
            T_WC, reason = self._poses.of(frame) if not self._poses.none else (None, "")
        except BadFrameError as e:
            self._staging.drop(i, "pose is not rigid", str(e))
            return
        if reason:
            self._staging.drop(i, reason)
            return
        try:
            images = frame.load()
        except BadFrameError as e:
            self._staging.drop(i, "image missing or damaged", str(e))
            return
        try:
            rectified = self._rectified(frame, images)
        except SequenceError:
            raise
        except ValueError as e:
            raise SequenceError(f"{frame.source}: {e}") from None
        depth, far_pixels = self._quantised(rectified.depth_m)
        if not depth.any():
            self._staging.drop(i, "no depth", f"{frame.source} holds no depth that can be written")
            return
        numbers = () if T_WC is None else tuple(T_WC.flatten().tolist())
        row = JournalEntry(i, time_s=frame.time_s, T_WC=numbers, far_pixels=far_pixels)
        lossless = not images.encoded.startswith(b"\xff\xd8")
        self._staging.write(row, rectified.encoded or rectified.rgb, depth, lossless=lossless)

    def _rectified(self, frame: RecordedFrame, images: RgbdImages) -> RgbdImages:
        height, width = images.rgb.shape[:2]
        model = self._model(frame, (width, height))
        if self._rectifier is None:
            camera = output_camera(model.fitted(width, height, frame.source), self._options.width, self._options.height)
            self._staging.set_camera(camera)
            self._rectifier = Rectifier(camera, along_ray=self._along_ray)
        return self._rectifier(frame, model, images)

    def _model(self, frame: RecordedFrame, size: tuple[int, int]) -> CameraModel:
        if self._options.intrinsics:
            return read_intrinsics(self._options.intrinsics, size, centre=self._options.pixel_centre)
        if frame.model is None:
            raise SequenceError(
                f"{self._recording.name} does not contain the camera's intrinsics; give --intrinsics 'fx fy cx cy' "
                "(pixels), "
                "or a file with them"
            )
        return frame.model

    def _quantised(self, depth_m: np.ndarray) -> tuple[np.ndarray, int]:
        """Stored depth, and how many pixels are farther than it can say."""
        stored = np.rint(depth_m * np.float32(self.depth_scale))
        far = stored > 65535
        return np.where(far, 0, stored).astype(np.uint16), int(far.sum())

    def _far_note(self) -> list[str]:
        far_pixels = sum(row.far_pixels for row in self._staging.kept)
        if not far_pixels:
            return []
        limit = 65535 / self.depth_scale
        return [f"{far_pixels} pixels beyond {limit:.1f} m, the limit of 16-bit depth, were set to missing"]

    def _time_hint(self, rows: list[JournalEntry]) -> str:
        """Both time ranges, if no frame has a pose in the trajectory."""
        trajectory = self._poses.trajectory
        if trajectory is None or not rows:
            return ""
        first, last = float(trajectory.stamps_s[0]), float(trajectory.stamps_s[-1])
        frame = next(iter(self._recording.frames()))
        return f"; the trajectory spans {first:.3f} to {last:.3f} s, the first frame is at {frame.time_s} s"
