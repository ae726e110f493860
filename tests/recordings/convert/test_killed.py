"""A conversion that is killed at any file operation goes on when it is called again, to the same bytes."""

import os
import sys
from pathlib import Path

import pytest

from gsfusion_nb.data import SequenceError
from gsfusion_nb.recordings.convert import convert

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
_KILLED, _ENDED, _FAILED = 9, 0, 1
_EVENTS = ("open", "os.rename", "os.mkdir", "os.remove", "os.rmdir", "shutil.rmtree", "os.truncate")


@pytest.fixture
def scan(tmp_path, takes):
    """Two frames in the manner of the TUM benchmark, one of them damaged."""
    root = tmp_path / "rgbd_dataset_freiburg3_small"
    for i in range(2):
        takes.write(root / f"rgb/{takes.times_s[i]}.png", takes.png(i))
        takes.write(root / f"depth/{takes.times_s[i]}.png", takes.depth_png(i, 5000))
    (root / f"rgb/{takes.times_s[1]}.png").write_bytes(b"damaged")
    c = takes.camera
    (root / "calibration.txt").write_text(f"{c.fx} {c.fy} {c.cx - 0.5} {c.cy - 0.5}")
    rows = [" ".join(map(repr, [takes.times_s[i], *takes.tum_row(i)])) for i in range(2)]
    (root / "groundtruth.txt").write_text("\n".join(rows))
    return root


def converted(source: Path, out: Path, stop_at: int) -> tuple[int, int]:
    """Convert in a child that ends without a word before file operation ``stop_at`` below the folder of ``out``; its
    exit status, and how many operations there were (if it ended by itself)."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        count = 0

        def operation(event: str, arguments: tuple) -> None:
            nonlocal count
            places = [a for a in arguments[:2] if isinstance(a, (str, Path))]
            if event in _EVENTS and any(str(p).startswith(str(out)) for p in places):
                count += 1
                if count == stop_at:
                    os._exit(_KILLED)

        sync = os.fsync
        os.fsync = lambda handle: (operation("open", (str(out),)), sync(handle))[1]
        sys.addaudithook(operation)
        try:
            convert(source, out)
            os.write(write, str(count).encode())
            os._exit(_ENDED)
        except BaseException as e:
            os.write(2, f"{type(e).__name__}: {e}\n".encode())
            os._exit(_FAILED)
    os.close(write)
    with os.fdopen(read) as told:
        text = told.read()
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return status, int(text or 0)


def content(folder: Path, out: Path) -> dict[str, bytes]:
    """Every file of a folder, with the folder's own name left out."""
    files = (p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): p.read_bytes().replace(str(out).encode(), b"OUT") for p in files}


@pytest.mark.parametrize("every", [5, pytest.param(1, marks=pytest.mark.slow)])
def test_killed_at_every_file_operation(tmp_path, scan, every):
    whole = tmp_path / "whole/out"
    whole.parent.mkdir()
    status, n = converted(scan, whole, stop_at=0)
    assert (status, n > 30) == (_ENDED, True)
    expected = content(whole, whole)
    assert len(expected) == 2 + 4
    stuck = []
    for stop_at in range(1, n + 1, every):
        out = tmp_path / f"{stop_at}/out"
        out.parent.mkdir()
        status, _ = converted(scan, out, stop_at)
        assert status == _KILLED, f"operation {stop_at} of {n}"
        if out.exists() and not out.with_name("out.partial").exists():
            assert content(out, out) == expected
            continue
        status, _ = converted(scan, out, stop_at=0)
        if status != _ENDED or content(out, out) != expected or out.with_name("out.partial").exists():
            stuck.append(stop_at)
    assert stuck == []


def test_killed_twice(tmp_path, scan):
    """The second run is killed where it takes up the work of the first."""
    expected = None
    for first, second in ((12, 3), (20, 9), (30, 2), (36, 4)):
        out = tmp_path / f"{first}-{second}/out"
        out.parent.mkdir()
        assert converted(scan, out, first)[0] == _KILLED
        assert converted(scan, out, second)[0] in (_KILLED, _ENDED)
        convert(scan, out)
        found = content(out, out)
        expected = expected or found
        assert found == expected


def test_pictures_that_a_power_failure_took_are_made_again(tmp_path, takes, scan):
    out, partial = tmp_path, tmp_path
    for stop_at in range(14, 60, 4):
        out = tmp_path / str(stop_at)
        assert converted(scan, out, stop_at)[0] == _KILLED
        partial = tmp_path / f"{stop_at}.partial"
        if (partial / "frames.jsonl").exists() and (partial / "frames.jsonl").stat().st_size:
            break
    (partial / "sequence/depth/000000.png").write_bytes(b"")
    convert(scan, out)
    takes.check(out, (0,), depth_m=2e-4)


def test_a_partial_folder_of_something_else_is_refused(tmp_path, scan):
    (tmp_path / "out.partial/sequence").mkdir(parents=True)
    with pytest.raises(SequenceError, match=r"out\.partial holds an unfinished conversion of another source"):
        convert(scan, tmp_path / "out")
