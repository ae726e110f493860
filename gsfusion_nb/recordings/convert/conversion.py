"""One pass over the frames of a recording, which writes them as a ``folder`` sequence, and its
report."""

import dataclasses
import itertools
import json
import statistics
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...data.adjust.resize import resized_camera
from ...data.recorded.stamps import judge_stamps
from ...data.room.hand_held import write_depth, write_rgb
from ...errors import BadFrameError, SequenceError
from ...files import parsing
from ...types import Camera
from .camera_numbers import doubt_of
from .frame_poses import FramePoses
from .intrinsics import intrinsics_of_frame, read_intrinsics
from .recording import (
    ConvertOptions,
    RecordedFrame,
    Recording,
    RgbdImages,
    is_picture_file,
    with_colour_bits,
)
from .rectifier import Rectifier
from .trajectory import read_matrix

MILLIMETRES = 1000.0
_FINEST = 20000.0
_COARSEST = 200.0
"""Depth scales of a recording that are kept; others (metres, floating point) are written in
millimetres."""

_PIXELS_PER_DEPTH = 16
_LONG_SIDE = 640
"""Images with more colour pixels than this for each of the depth (iPhone: 56) are written with this
long side."""


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

    def __str__(self) -> str:
        c = self.camera
        lines = [
            f"{self.frames} of {self.frames_read} frames ({self.format}) in {self.out}",
            f"  camera {c.width}x{c.height}, fx {c.fx:.2f} fy {c.fy:.2f} cx {c.cx:.2f} cy "
            f"{c.cy:.2f}, pixel centre 0.5",
            f"  depth in 16-bit PNG, {self.depth_scale:g} per metre, 0 = missing; "
            + ("poses camera-to-world in metres" if self.has_poses else "no poses"),
            *(f"  left out {n}: {reason}" for reason, n in self.dropped.items()),
            *(f"    {example}" for example in self.examples),
            *(f"  note: {note}" for note in self.notes),
            "Next: gsfusion-nb check "
            f"{self.out}{'' if self.has_poses else ' --reader poses=false'}",
        ]
        return "\n".join(lines)


def _without_depth(source: str, depth_m: np.ndarray, scale: float) -> str:
    """Why no pixel of a depth image can be written."""
    depth_values = depth_m[depth_m > 0]
    if not len(depth_values):
        return f"{source} holds no depth that can be written"
    middle = float(np.median(depth_values))
    usual = ", and --depth-scale 1000 if it is in millimetres" if 100 < middle < 20_000 else ""
    return (
        f"{source} holds no depth that can be written: the median is {middle:g} m, and the limit "
        "of 16 bits "
        f"{65535 / scale:.1f} m; give --depth-scale, the stored value of one metre{usual}"
    )


class Conversion:
    """One pass over the frames of a recording: images are written at once, poses and times at the
    end."""

    def __init__(self, recording: Recording, options: ConvertOptions, folder: Path):
        self._recording = recording
        self._options = options
        self._folder = folder
        self._poses = FramePoses(recording, options)
        self._T_colour_depth = (
            read_matrix(Path(options.T_colour_depth)) if options.T_colour_depth else None
        )
        scale = options.depth_scale or recording.depth_scale
        self._depth_scale = scale if _COARSEST <= scale <= _FINEST else MILLIMETRES
        self._rectifier: Rectifier | None = None
        self._dropped: Counter[str] = Counter()
        self._errors: list[str] = []
        self._times: list[float | None] = []
        self._depth_times: list[float | None] = []
        self._lines: list[str] = []
        """The poses of the frames that were written."""
        self._far_pixels = 0
        self._about_camera: list[str] = []
        """Notes that intrinsics are doubtful, and that images were made smaller."""
        (folder / "rgb").mkdir()

    def add(self, place: int, frame: RecordedFrame) -> None:
        """Write the frame at a place of the recording, or leave it out and count why."""
        T_WC = None
        frame = self._poses.timed(frame)
        if not self._poses.none:
            try:
                T_WC, reason = self._poses.of(place, frame)
                # poses may have the stamps of depth
                if T_WC is None and frame.depth_time_s is not None:
                    frame = dataclasses.replace(frame, time_s=frame.depth_time_s)
                    T_WC, reason = self._poses.of(place, frame)
            except BadFrameError as e:
                return self._drop("pose is not rigid", str(e))
            if T_WC is None:
                return self._drop(reason)
        try:
            with parsing(frame.source, "colour and depth", BadFrameError):
                images = with_colour_bits(frame.load(), self._options.colour_bits, frame.source)
        except BadFrameError as e:
            return self._drop("image missing or damaged", str(e))
        try:
            pinhole_images = self._rectified(frame, images)
        except SequenceError:
            raise
        except ValueError as e:
            raise SequenceError(f"{frame.source}: {e}") from None
        depth_values = np.rint(pinhole_images.depth_m * np.float32(self._depth_scale))
        is_too_far = depth_values > 65535
        depth = np.where(is_too_far, 0, depth_values)
        if not depth.any():
            return self._drop(
                "no depth", _without_depth(frame.source, pinhole_images.depth_m, self._depth_scale)
            )
        name = f"{len(self._times):06d}"
        lossless = not images.encoded.startswith(b"\xff\xd8")
        colour = self._folder / f"rgb/{name}{'.png' if lossless else '.jpg'}"
        if is_picture_file(pinhole_images.encoded):
            colour.write_bytes(pinhole_images.encoded)
        else:
            write_rgb(colour, pinhole_images.rgb)
        write_depth(self._folder / f"depth/{name}.png", depth, 1.0)
        self._far_pixels += int(is_too_far.sum())
        self._times.append(frame.time_s)
        one_time = frame.depth_time_s is None or self._poses.by_place
        self._depth_times.append(frame.time_s if one_time else frame.depth_time_s)
        if T_WC is not None:
            self._lines.append(" ".join(repr(v) for v in T_WC.flatten().tolist()))
        return None

    def finish(self, format: str, out: Path) -> ConvertReport:
        """Write intrinsics, poses, times and the report."""
        drop_counts = dict(Counter(self._recording.dropped) + self._dropped)
        if not self._times or self._rectifier is None:
            reasons = "; ".join(
                [
                    *(f"{n} left out: {reason}" for reason, n in drop_counts.items()),
                    *self._errors[:1],
                ]
            )
            raise SequenceError(
                f"{self._recording.name}: no frame can be used "
                f"({reasons or 'it has none'}){self._time_hint()}; expected at least one"
            )
        stamps = judge_stamps([t for t in self._times if t is not None], unit="s")
        notes = [*self._recording.notes, *self._poses.notes, *self._about_camera]
        if self._far_pixels:
            limit = 65535 / self._depth_scale
            notes.append(
                f"{self._far_pixels} pixels beyond {limit:.1f} m, the limit of 16-bit depth, were "
                "set to missing"
            )
        if len(self._lines) > 2 and len(set(self._lines)) == 1:
            notes.append(
                f"all {len(self._lines)} poses are equal: the camera stood still, or nobody knew "
                "them; --poses none tracks the camera later"
            )
        if stamps.times_s is None:
            notes.append(
                f"the recorded times are not times: {stamps.why_not}; no times or frame rate are "
                "written"
            )
            self._times = self._depth_times = [None] * len(self._times)
        elif not stamps.times_s:
            notes.append("the recording has no times: no times or frame rate are written")
        report = ConvertReport(
            out=out,
            format=format,
            frames_read=len(self._times) + self._dropped.total(),
            frames=len(self._times),
            dropped=drop_counts,
            examples=tuple(self._errors[:3]),
            camera=self._rectifier.camera,
            depth_scale=self._depth_scale,
            has_poses=not self._poses.none,
            notes=tuple(notes),
        )
        steps = [b - a for a, b in itertools.pairwise(stamps.times_s or []) if b > a]
        intrinsics = {
            **{k: getattr(report.camera, k) for k in ("width", "height", "fx", "fy", "cx", "cy")},
            "pixel_centre": 0.5,
            "pose_convention": "camera-to-world, OpenCV axes, metres",
            "depth_scale": self._depth_scale,
            **({"fps": 1.0 / statistics.median(steps)} if steps else {}),
        }
        has_depth_times = self._depth_times != self._times
        times = {"time_s": self._times} | (
            {"depth_time_s": self._depth_times} if has_depth_times else {}
        )
        table = zip(*times.values(), strict=True)
        rows = (
            " ".join([f"{i:06d}", *("nan" if t is None else repr(t) for t in row)])
            for i, row in enumerate(table)
        )
        if self._lines:
            (self._folder / "poses.txt").write_text("\n".join([*self._lines, ""]))
        (self._folder / "times.txt").write_text("\n".join([" ".join(["frame", *times]), *rows, ""]))
        (self._folder / "intrinsics.json").write_text(json.dumps(intrinsics, indent=1))
        document = {**dataclasses.asdict(report), "out": str(out), "source": self._recording.name}
        (self._folder / "conversion.json").write_text(json.dumps(document, indent=1))
        return report

    def _drop(self, reason: str, error: str = "") -> None:
        self._dropped[reason] += 1
        if error:
            self._errors.append(error)

    def _rectified(self, frame: RecordedFrame, images: RgbdImages) -> RgbdImages:
        height, width = images.rgb.shape[:2]
        model = intrinsics_of_frame(frame, (width, height), self._recording.name, self._options)
        frame = self._with_depth_camera(frame, images.depth_m.shape)
        if self._rectifier is None:
            fitted = model.fitted(width, height, frame.source)
            if doubt := doubt_of(fitted.camera):
                self._about_camera.append(doubt)
            pinhole = fitted.pinhole()
            h, w = images.depth_m.shape
            size = (self._options.width, self._options.height)
            coarse = width * height > _PIXELS_PER_DEPTH * h * w
            if coarse and not any(size) and max(width, height) > _LONG_SIDE:
                size = (_LONG_SIDE, 0) if width >= height else (0, _LONG_SIDE)
                self._about_camera.append(
                    f"colour is {width}x{height}, depth {w}x{h}: written with {_LONG_SIDE} pixels "
                    f"on the longer side, --width {width} writes all of them"
                )
            camera = resized_camera(pinhole, *size)
            self._rectifier = Rectifier(camera, along_ray=self._recording.depth_along_ray)
        return self._rectifier(frame, model, images)

    def _with_depth_camera(self, frame: RecordedFrame, shape: tuple[int, ...]) -> RecordedFrame:
        """The frame with the depth camera of the options, where they give one."""
        intrinsics_file = self._options.depth_intrinsics
        T = self._T_colour_depth
        if intrinsics_file == "colour":
            return dataclasses.replace(frame, depth_model=None, T_colour_depth=None)
        if intrinsics_file:
            model = read_intrinsics(
                intrinsics_file,
                (shape[1], shape[0]),
                centre=self._options.pixel_centre,
            )
            frame = dataclasses.replace(frame, depth_model=model)
        return frame if T is None else dataclasses.replace(frame, T_colour_depth=T)

    def _time_hint(self) -> str:
        """Both time ranges, if no frame has a pose in the trajectory."""
        trajectory = self._poses.trajectory
        if trajectory is None or not self._dropped:
            return ""
        first = float(trajectory.stamps_s[0])
        last = float(trajectory.stamps_s[-1])
        frame = next(iter(self._recording.frames()))
        return (
            f"; the trajectory spans {first:.3f} to {last:.3f} s, the first frame is at "
            f"{frame.time_s} s"
        )
