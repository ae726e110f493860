"""Where the time of a run goes: stages that add up, and frames that are read once."""

import contextlib
import json
import threading
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from gsfusion_nb.config import gps_slam
from gsfusion_nb.data.room import RoomSequence
from gsfusion_nb.mapping import gps_surface
from gsfusion_nb.runs import FinishedRun, run_mapping, scores
from gsfusion_nb.runs.run_clock import STAGES, RunClock


class Ticks:
    """A clock that is set by hand."""

    def __init__(self):
        self.time = 100.0

    def __call__(self) -> float:
        return self.time


def test_a_stage_inside_another_counts_for_itself_alone():
    ticks = Ticks()
    clock = RunClock(clock=ticks, cpu=lambda: 0.5 * ticks.time)
    ticks.time += 1
    with clock("view_scores"):
        ticks.time += 2
        with clock("reading"):
            ticks.time += 4
        ticks.time += 8
    with contextlib.suppress(KeyError), clock("mesh"):
        ticks.time += 16
        raise KeyError
    found = clock.metrics()
    wanted = dict.fromkeys(STAGES, 0.0) | {
        "other": 1.0,
        "view_scores": 10.0,
        "reading": 4.0,
        "mesh": 16.0,
    }
    assert found == {f"seconds_{stage}": s for stage, s in wanted.items()} | {"seconds_total": 31.0}
    assert clock.cpu_seconds == {stage: s / 2 for stage, s in wanted.items()}


def test_what_another_thread_does_is_not_counted():
    ticks = Ticks()
    clock = RunClock(clock=ticks, cpu=ticks)

    def read() -> None:
        with clock("reading"):
            ticks.time += 1

    with clock("mapping"):
        thread = threading.Thread(target=read)
        thread.start()
        thread.join()
    assert (clock.seconds["mapping"], clock.seconds["reading"]) == (1.0, 0.0)


def test_a_continued_run_adds_to_the_times_before():
    ticks = Ticks()
    first = RunClock(clock=ticks, cpu=ticks)
    second = RunClock(clock=ticks, cpu=ticks)
    with first("passes"):
        ticks.time += 3
    second.load_state_dict(first.state_dict())
    with second("passes"):
        ticks.time += 2
    assert second.seconds["passes"] == second.cpu_seconds["passes"] == 5.0


@pytest.fixture(scope="module")
def counted(tmp_path_factory) -> tuple[FinishedRun, Counter[int], Counter[str]]:
    """A scored run of GPS-SLAM, how often it read each frame, and how often it cast rays for its
    scores."""
    reads = Counter[int]()
    looks = Counter[str]()
    data: dict[str, Any] = {
        "data__width": 0,
        "data__height": 0,
        "data__hold_out_every": 4,
        "data__hold_out_offset": 1,
    }
    config = gps_slam("room", tsdf__voxel_size_m=0.04, final__passes=1, **data)
    with pytest.MonkeyPatch.context() as patch:
        read = RoomSequence.__getitem__
        cast = gps_surface.raycast
        stored = gps_surface.as_stored

        def counted_read(self, i):
            reads[int(i)] += 1
            return read(self, i)

        def counted_cast(*args):
            looks["rays"] += 1
            return cast(*args)

        def counted_stored(volume):
            looks["rounded"] += 1
            return stored(volume)

        patch.setattr(scores, "SURFACE_SAMPLES", 4_000)
        patch.setattr(RoomSequence, "__getitem__", counted_read)
        patch.setattr(gps_surface, "raycast", counted_cast)
        patch.setattr(gps_surface, "as_stored", counted_stored)
        folder = tmp_path_factory.mktemp("counted") / "run"
        done = run_mapping("room", config, folder=folder, n_frames=8, width=80, height=60)
    return done, reads, looks


def test_a_run_reads_each_frame_once(counted):
    _, reads, _ = counted
    assert reads == dict.fromkeys(range(8), 1)


def test_views_are_looked_at_once_for_all_scores(counted):
    """Eight views are scored before and after the passes; the report draws five of them from the
    map as it is."""
    done, _, looks = counted
    assert looks["rounded"] == 1
    assert (
        looks["rays"] == done.metrics["n_views_held_out"] + done.metrics["n_views_mapped"] + 5 == 13
    )
    assert done.mapper.files.stored_looks.n_bytes == 0, "given back at the end"
    assert done.run.sequence.kept is not None
    assert len(done.run.sequence.kept) == 0


def test_the_stages_of_a_run_add_up_to_its_time(counted):
    done, _, _ = counted
    stored = json.loads((Path(done.folder) / "metrics.json").read_text())["metrics"]
    stages = [stored[f"seconds_{stage}"] for stage in STAGES]
    assert sum(stages) == pytest.approx(stored["seconds_total"])
    assert stored["seconds_mapping"] >= stored["seconds_online"] > 0
    assert all(
        stored[f"seconds_{stage}"] > 0
        for stage in ("reading", "passes", "mesh", "view_scores", "mesh_scores")
    )
    assert "Time of the whole run" in (done.folder / "report.html").read_text()
