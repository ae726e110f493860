import errno
import os
import re
import subprocess
import sys
import tempfile
from typing import Any

import pytest
import torch

from gsfusion_nb.cli.map import memory_needed_gb
from gsfusion_nb.config import DataConfig, TsdfConfig, gps_slam, gsfusion, replace, rtg_slam
from gsfusion_nb.data import SequenceError, open_sequence
from gsfusion_nb.data.room import RoomSequence
from gsfusion_nb.mapping import get_system, make_mapper
from gsfusion_nb.resources import MAP_MEMORY, map_memory
from gsfusion_nb.runs.map_hashes import hash_of
from gsfusion_nb.tsdf import TsdfVolume, estimate_memory

CPU = torch.device("cpu")


@pytest.fixture
def in_files(monkeypatch, tmp_path):
    """Everything is in files, of which the pages are given back each time."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(MAP_MEMORY, "limit_bytes", None)
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(MAP_MEMORY, "_shared_file", None)
    monkeypatch.setattr(MAP_MEMORY, "_files", {})  # tests before may have left some
    MAP_MEMORY.limit(1e-9)
    monkeypatch.setattr(map_memory, "resident_bytes", lambda field: 1 << 60)
    yield MAP_MEMORY
    MAP_MEMORY.limit(None)


def test_rows_in_files_grow_without_a_copy_and_survive_when_memory_is_given_back(in_files):
    rows = in_files.rows(3, 4, dtype=torch.int32, device=CPU)
    assert not rows.any()
    assert in_files.is_in_files(CPU)
    assert len(in_files._files) == 1
    rows[:] = torch.arange(12, dtype=torch.int32).view(3, 4)
    more = in_files.extend(rows, 2000)
    rows[0, 0] = 7  # the same file
    in_files.give_back()
    assert more[:3].flatten().tolist() == [7, *range(1, 12)]
    assert not more[3:].any()
    image = torch.rand(5, 6)
    assert torch.equal(in_files.in_file(image), image)
    in_memory = torch.ones(2, 4)  # made before the limit
    assert in_files.extend(in_memory, 4).sum() == 8
    del rows, more
    assert len(in_files._files) == 1  # that of the images


@pytest.mark.parametrize("settings", [gsfusion, rtg_slam, gps_slam])
def test_the_map_has_the_same_bits_in_files(settings, in_files, monkeypatch):
    config = settings("room")
    frames = RoomSequence(n_frames=12, width=64, height=48)

    def hashes() -> dict[str, str]:
        mapper = make_mapper(config)
        for i in range(5):
            mapper.step(frames[i])
        surface = {} if settings is rtg_slam else {"mesh": vars(mapper.mesh())}
        return {
            name: hash_of(x, mapper.files.order_of_rows(name))
            for name, x in (mapper.files.maps() | surface).items()
        }

    there = hashes()
    MAP_MEMORY.limit(None)
    assert hashes() == there


def test_a_full_disk_is_an_error_before_anything_changes(in_files, monkeypatch):
    volume = TsdfVolume(replace(TsdfConfig(), voxel_size_m=0.05))
    volume.add_blocks(torch.tensor([[0, 0, 0]]))

    def full(fd: int, start: int, n_bytes: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
    with pytest.raises(MemoryError):
        volume.add_blocks(torch.stack([torch.arange(5000)] * 3, 1))
    assert volume.n_blocks == 1
    assert bool((volume.D == 1).all())


@pytest.mark.parametrize("gb", [0, -1, float("nan")])
def test_a_limit_that_is_none_is_refused(gb):
    with pytest.raises(ValueError, match=str(gb)):
        MAP_MEMORY.limit(gb)


def test_the_memory_of_a_map_is_known_before_it_is_made():
    config = replace(gsfusion("room"), data__width=64, data__height=48)
    sequence = open_sequence("room", data=config.data, n_frames=30)
    needed = memory_needed_gb(sequence, config)
    mapper = make_mapper(config)
    for i in range(len(sequence.mapping)):
        mapper.step(sequence.mapping[i])
    assert needed["voxel blocks"] == pytest.approx(
        estimate_memory(mapper.volume.n_blocks, weighs_colours=mapper.volume.config.weighs_colours)
        / 1e9,
        rel=1e-6,
    )
    n_bytes = sum(column.nbytes for column in mapper.gaussians.columns.values())
    assert needed["Gaussians"] == pytest.approx(n_bytes / 1e9, rel=0.5)
    assert needed["mesh"] == pytest.approx(len(mapper.mesh().faces) * 130 / 1e9, rel=0.3)


_RUN = """
import pathlib, sys
from gsfusion_nb.cli import main
status = main(sys.argv[1:])
print(pathlib.Path("/proc/self/status").read_text())
sys.exit(status)
"""
"""Not ``getrusage``, which counts what the process that starts this one takes."""


@pytest.mark.ci
@pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read from /proc")
@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam", "gps_slam"])
def test_a_run_takes_the_memory_that_was_foretold(system, tmp_path):
    """Of a whole run: the mesh and the copies that are written and scored are in it."""
    options: dict[str, Any] = {"n_frames": 40, "width": 160, "height": 120}
    data = DataConfig(width=160, height=120)
    config = replace(get_system(system).preset("room"), data=data)
    foretold_gb = sum(
        memory_needed_gb(open_sequence("room", data=data, **options), config).values()
    )
    call = ["map", "room", "--system", system, "--out", str(tmp_path / "run")]
    call += ["--reader", *(f"{name}={value}" for name, value in options.items())]
    call += ["--data.width", "160", "--data.height", "120"]
    process = subprocess.run(
        [sys.executable, "-c", _RUN, *call], capture_output=True, text=True, check=True
    )
    peak_kb = re.search(r"VmHWM:\s+(\d+) kB", process.stdout)
    assert peak_kb is not None
    peak_gb = int(peak_kb[1]) / 1e6
    assert 0.9 * peak_gb < foretold_gb < 1.4 * peak_gb


def test_without_poses_the_memory_is_not_known(monkeypatch):
    sequence = open_sequence("room", n_frames=4)
    monkeypatch.setattr(RoomSequence, "has_poses", False, raising=False)
    with pytest.raises(SequenceError):
        memory_needed_gb(sequence, gsfusion("room"))
