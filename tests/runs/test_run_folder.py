"""A disk that is full costs no map that was made."""

import contextlib
import errno
import shutil
import subprocess
from typing import Any

import pytest

from gsfusion_nb.errors import DiskFullError
from gsfusion_nb.runs import CheckpointEvery, resume_mapping, run_mapping
from gsfusion_nb.runs.run_folder import RunFolder, new_folder


def test_a_second_run_is_refused_and_the_folder_is_free_afterwards(tmp_path):
    with RunFolder(tmp_path), pytest.raises(FileExistsError, match="is in use"):
        RunFolder(tmp_path).__enter__()
    with RunFolder(tmp_path):
        pass
    (tmp_path / "checkpoint").mkdir()
    (tmp_path / "checkpoint" / "000001.json").write_text("")
    with pytest.raises(FileExistsError, match="--resume"):
        new_folder("x", tmp_path)


def test_a_run_cut_off_before_its_first_checkpoint_can_be_begun_anew(tmp_path):
    with RunFolder(tmp_path / "out"):
        pass
    (tmp_path / "out" / "checkpoint").mkdir()
    for name in ("checkpoint/000001.state", ".gaussians.00112233.partial.ply"):
        (tmp_path / "out" / name).write_text("")
    assert new_folder("x", tmp_path / "out") == tmp_path / "out"
    with RunFolder(tmp_path / "out"):
        assert not list((tmp_path / "out").glob("*.partial*"))
    (tmp_path / "out" / "gaussians.ply").write_text("precious")
    with pytest.raises(FileExistsError, match="new or empty folder"):
        new_folder("x", tmp_path / "out")


def test_where_files_cannot_be_locked_nobody_is_kept_out(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")

    def no_locks(handle, how):
        raise OSError(errno.ENOTSUP, "no locks here")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with RunFolder(tmp_path), RunFolder(tmp_path):
        pass


resource = pytest.importorskip("resource")
SMALL: dict[str, Any] = {"n_frames": 120, "width": 80, "height": 60}


@contextlib.contextmanager
def files_of_at_most(size: int):
    """The system refuses larger files, as a quota does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_checkpoints_that_do_not_fit_do_not_end_the_run(tmp_path, small_room, config, caplog):
    with files_of_at_most(3_000_000):
        run = run_mapping(
            "room",
            config,
            folder=tmp_path / "out",
            evaluate=False,
            checkpoints=CheckpointEvery(seconds=0, frames=2),
            n_frames=120,
            width=80,
            height=60,
        )
    assert run.run.status == "complete"
    assert "this checkpoint could not be saved" in caplog.text
    assert "state cannot be written" in caplog.text
    assert (run.folder / "gaussians.ply").exists()


def test_maps_that_fit_are_kept_and_the_run_goes_on_when_there_is_room(
    tmp_path, config, monkeypatch, whole_run
):
    from gsfusion_nb.runs import outputs

    every = CheckpointEvery(seconds=0, frames=3)
    write_gaussians = outputs.write_gaussian_ply

    def full(path, params):
        raise DiskFullError(errno.ENOSPC, f"{path} cannot be written: the disk is full")

    monkeypatch.setattr(outputs, "write_gaussian_ply", full)
    with pytest.raises(
        DiskFullError, match=r"gaussians\.ply cannot be written: the disk is full"
    ) as failure:
        run_mapping(
            "room", config, folder=tmp_path / "out", evaluate=False, checkpoints=every, **SMALL
        )
    monkeypatch.setattr(outputs, "write_gaussian_ply", write_gaussians)
    assert "gsfusion-nb map --resume" in " ".join(failure.value.__notes__)
    assert (tmp_path / "out" / "trajectory.txt").exists()
    resumed = resume_mapping(tmp_path / "out", evaluate=False)
    assert resumed.run.hashes == whole_run.run.hashes
    assert resumed.run.warnings == []


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 3 MB; mounting one needs rights that only some machines give."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(place)]
    made = (
        subprocess.run(command, capture_output=True, text=True) if shutil.which("mount") else None
    )
    if made is None or made.returncode != 0:
        pytest.skip(
            "no disk can be mounted here: "
            f"{made.stderr.strip() if made else 'there is no command mount'}"
        )
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def test_a_disk_that_is_really_full(small_disk, config, caplog, whole_run):
    """The run goes to its end, what fits is kept, and with room again the maps are those of any
    other disk."""
    every = CheckpointEvery(seconds=0, frames=3)
    filler = small_disk / "filler"
    filler.write_bytes(bytes(2_600_000))
    with pytest.raises(DiskFullError, match=r"cannot be written: the disk is full") as full:
        run_mapping(
            "room", config, folder=small_disk / "out", evaluate=False, checkpoints=every, **SMALL
        )
    assert str(small_disk) in str(full.value)
    assert "this checkpoint could not be saved" in caplog.text
    kept = {p.name for p in (small_disk / "out").iterdir()}
    assert "config.json" in kept
    assert not any(".partial" in name for name in kept)
    filler.unlink()
    again = run_mapping("room", config, folder=small_disk / "again", evaluate=False, **SMALL)
    assert again.run.hashes == whole_run.run.hashes
