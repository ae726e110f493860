"""Another recording located in the map of a run: poses, errors, files and a report."""

import itertools
import logging
import math
import time
from collections.abc import Sequence as Rows
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from ..config import DataConfig
from ..data import FrameSubset, OpenedSequence, Sequence, apply_options, open_sequence
from ..data.adjust.repair import as_read
from ..errors import SequenceError
from ..evaluation import metrics_as_json
from ..export import write_trajectory_tum
from ..mapping import Mapper
from ..mapping.usual_torch import in_usual_torch
from ..progress import ProgressDisplay
from ..tracking import Location, Locator, locate_all
from ..types import Frame
from .located_frames import LocatedFrame, LocatedRecording, location_metrics
from .location_report import write_location_page
from .mapping_run import has_poses
from .outputs import write_json
from .run_folder import METRICS, RunFolder, new_folder
from .stored_map import StoredMap, open_map

log = logging.getLogger(__name__)

SameFrame = Literal["auto", "yes", "no"]


@in_usual_torch
def locate(
    run: Path | str,
    data: str | Path | Sequence,
    *,
    folder: Path | str | None = None,
    frames: DataConfig | None = None,
    same_frame: SameFrame = "auto",
    system: str | type[Mapper] | None = None,
    device: torch.device | str = "cpu",
    **reader_options: Any,
) -> LocatedRecording:
    """Find the frames of a recording in the map of another run, which does not change.

    The poses of the recording are not used. A frame that cannot be found has no pose; none is
    guessed. Files: trajectory.txt (located frames, TUM format), metrics.json (all frames) and
    report.html.

    Args:
        run: Folder of the run.
        data: Folder of a recording, "room", or any ``Sequence``.
        folder: New or empty folder for the files; ``runs/located-<name>-<time>`` by default.
        frames: Which frames, and their size; by default all, as wide as those of the run.
        same_frame: Whether the poses of the recording are in the frame of the map, so that they are
            the truth to compare with. "auto": if it is the recording of the run.
        system: Of a run whose system came from a file: "RUN/system.py:Name", which is executed, or
            its class.
        device: Where the map is drawn.
        reader_options: For ``open_sequence``: ``format``, options of the reader.

    Raises:
        FileNotFoundError: no such run or recording, or a run of an older version.
        ValueError: a file is damaged.
    """
    start = time.perf_counter()
    stored = open_map(run, device, system)
    locator = Locator(stored.places, stored.surface, stored.config.tracking)
    selection = frames or default_frames(stored)
    if isinstance(data, (str, Path)):
        sequence = open_sequence(data, data=selection, **reader_options)
    else:
        sequence = apply_options(data, selection)
    seconds_opening = time.perf_counter() - start
    truth = poses_in_frame_of_map(stored, data, sequence, same_frame)
    place = new_folder(f"located-{sequence.name}", folder)
    with RunFolder(place):
        rows, note = _located(locator, sequence.mapping, truth, torch.device(device))
        metrics = location_metrics(rows, has_truth=truth is not None) | {
            "seconds_opening_map": seconds_opening
        }
        found = LocatedRecording(
            frames=rows, metrics=metrics, folder=place, warnings=[note] if note else []
        )
        _write(found, stored, sequence)
    return found


def default_frames(stored: StoredMap) -> DataConfig:
    """All frames of a recording, as wide as those of the run, with its limits of depth."""
    data = stored.config.data
    return DataConfig(
        width=stored.places.camera.width,
        depth_min_m=data.depth_min_m,
        depth_max_m=data.depth_max_m,
        hold_out_every=0,
    )


def poses_in_frame_of_map(
    stored: StoredMap, data: Any, sequence: OpenedSequence, same_frame: SameFrame
) -> dict[int, Tensor] | None:
    """Frame index -> true pose, where the poses of the recording are in the frame of the map; None
    if they are not."""
    is_same = same_frame == "yes"
    if same_frame == "auto" and isinstance(data, (str, Path)):
        is_same = _same_place(stored.source.get("path_or_name"), str(data))
    true_pose = getattr(as_read(sequence.source), "true_pose", None)
    if not is_same or not (has_poses(sequence) or true_pose is not None):
        return None
    mapping = sequence.mapping
    poses: dict[int, Tensor] = {}
    for i, index in enumerate(mapping.positions):
        try:
            poses[index] = mapping.pose(i) if true_pose is None else true_pose(index)
        except SequenceError:
            continue
    return poses


def _same_place(source: Any, data: str) -> bool:
    if "room" in (source, data):
        return source == data
    return isinstance(source, str) and Path(source) == Path(data).expanduser().resolve()


class _Timed(Locator):
    """A locator that remembers how long each frame took."""

    seconds = 0.0

    def locate(self, frame: Frame) -> Location:
        start = time.perf_counter()
        try:
            return super().locate(frame)
        finally:
            self.seconds = time.perf_counter() - start


def _located(
    locator: Locator,
    view: FrameSubset,
    truth: dict[int, Tensor] | None,
    device: torch.device,
) -> tuple[list[LocatedFrame], str]:
    """All frames with their locations; after Ctrl-C those until then, and a note."""
    timed = _Timed(locator.places, locator.surface, locator.config)
    on_device = _OnDevice(view, device)
    rows: dict[int, LocatedFrame] = {}
    note = ""
    with ProgressDisplay("locating", total=len(view), unit="frame") as progress:
        try:
            for i, location in locate_all(timed, on_device):
                index = view.positions[i]
                earlier = rows.get(i)
                rows[i] = LocatedFrame(
                    index=index,
                    timestamp_s=on_device.timestamps_s.get(i, math.nan),
                    location=location,
                    T_WC_true=None if truth is None else truth.get(index),
                    seconds=earlier.seconds if earlier else timed.seconds,
                )
                n_located = sum(row.location.is_located for row in rows.values())
                progress.show(len(rows), note=f"{n_located} located")
        except KeyboardInterrupt:
            note = f"interrupted after {len(rows)} of {len(view)} frames"
    return [rows[i] for i in sorted(rows)], note


class _OnDevice:
    """The frames of a view on a device, and the times of those that were read."""

    def __init__(self, view: FrameSubset, device: torch.device):
        self._view = view
        self._device = device
        self.timestamps_s: dict[int, float] = {}

    def __len__(self) -> int:
        return len(self._view)

    def __getitem__(self, i: int) -> Frame:
        frame = self._view[i].to(self._device)
        self.timestamps_s[i] = frame.timestamp_s
        return frame


def _write(found: LocatedRecording, stored: StoredMap, sequence: OpenedSequence) -> None:
    """Write trajectory, report and numbers, which come last."""
    located_rows = [row for row in found.frames if row.location.is_located]
    if located_rows:
        poses = torch.stack(list(found.poses.values()))
        write_trajectory_tum(found.folder / "trajectory.txt", _times(located_rows), poses.cpu())
    write_location_page(found.folder / "report.html", found, stored, sequence)
    document = {
        "status": "interrupted" if found.warnings else "complete",
        "warnings": found.warnings,
        "map": str(stored.folder.resolve()),
        "recording": sequence.name,
        "metrics": metrics_as_json(found.metrics),
        "frames": [row.as_json() for row in found.frames],
    }
    write_json(found.folder / METRICS, document)


def _times(rows: Rows[LocatedFrame]) -> list[float]:
    """The times of the frames, or their numbers if the recording has none that grow."""
    times_s = [row.timestamp_s for row in rows]
    grow = all(a < b for a, b in itertools.pairwise(times_s))
    return times_s if grow and all(map(math.isfinite, times_s)) else [float(r.index) for r in rows]
