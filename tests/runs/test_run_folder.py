import json
import os
import platform

import pytest

from gsfusion_nb.runs import run_folder
from gsfusion_nb.runs.run_folder import RunFolder, new_folder, read_status

PROGRESS = {"frames": 3, "of": 9}


def test_the_status_says_who_runs_what(tmp_path):
    with RunFolder(tmp_path / "out") as place:
        place.write_status("running", PROGRESS, system="gsfusion", settings={"seed": 0})
        place.write_status("running", PROGRESS | {"frames": 4})
        status = read_status(place.path)
    assert (status["pid"], status["host"]) == (os.getpid(), platform.node())
    assert (status["state"], status["progress"]["frames"], status["system"]) == ("running", 4, "gsfusion")
    assert status["settings"] == {"seed": 0}
    assert {p.name for p in place.path.iterdir()} == {"status.json"}


def test_a_second_run_is_refused_and_the_folder_is_free_afterwards(tmp_path):
    with RunFolder(tmp_path) as first:
        first.write_status("running", PROGRESS)
        for refused in (lambda: RunFolder(tmp_path).__enter__(), lambda: new_folder("x", tmp_path)):
            with pytest.raises(FileExistsError, match=rf"is in use: process {os.getpid()} on .* is writing to it"):
                refused()
        first.write_status("complete", PROGRESS)
    with RunFolder(tmp_path) as second:
        assert second.taken_over == ""


def test_a_run_that_was_cut_off_is_taken_over_with_a_sentence(tmp_path):
    with RunFolder(tmp_path) as first:
        first.write_status("running", PROGRESS)
    (tmp_path / ".lock").write_text("")  # left by a process that was killed
    with RunFolder(tmp_path) as second:
        assert f"process {os.getpid()} on {platform.node()}" in second.taken_over
        assert "was interrupted; its run continues from the last checkpoint" in second.taken_over
    (tmp_path / "checkpoint").mkdir()
    (tmp_path / "checkpoint" / "000001.json").write_text("")
    with pytest.raises(FileExistsError, match=r"must be a new or empty folder.*gsfusion-nb map --resume"):
        new_folder("x", tmp_path)


def test_a_run_cut_off_before_its_first_checkpoint_can_be_begun_anew(tmp_path):
    with RunFolder(tmp_path / "out") as first:
        first.write_status("running", PROGRESS)
    (tmp_path / "out" / "checkpoint").mkdir()
    for name in ("checkpoint/000001.pieces", ".gaussians.00112233.partial.ply"):
        (tmp_path / "out" / name).write_text("")
    assert new_folder("x", tmp_path / "out") == tmp_path / "out"
    assert [p.name for p in (tmp_path / "out").rglob("*")] == ["checkpoint"]
    (tmp_path / "out" / "status.json").write_text("{}")
    (tmp_path / "out" / "gaussians.ply").write_text("precious")
    with pytest.raises(FileExistsError, match="must be a new or empty folder, so that no earlier run is overwritten"):
        new_folder("x", tmp_path / "out")


@pytest.mark.parametrize(
    ("change", "dead"),
    [({}, False), ({"process_start": 1}, True), ({"boot": "another"}, True), ({"pid": 2**22 + 1}, True),
     ({"host": "elsewhere"}, False)],
)  # fmt: skip
def test_where_files_cannot_be_locked_the_status_decides(tmp_path, monkeypatch, change, dead):
    """A process id that is used again, another start of the machine, a process that is gone."""
    if not os.path.exists("/proc/self/stat"):
        pytest.skip("this system does not say when a process started")
    with RunFolder(tmp_path) as first:
        first.write_status("running", PROGRESS)
    status = json.loads((tmp_path / "status.json").read_text()) | change
    (tmp_path / "status.json").write_text(json.dumps(status))
    monkeypatch.setattr(run_folder, "try_lock", lambda handle: False)
    if dead:
        with RunFolder(tmp_path) as second:
            assert "was interrupted" in second.taken_over
    else:
        with pytest.raises(FileExistsError, match="is in use"):
            RunFolder(tmp_path).__enter__()


def test_an_unreadable_status_does_not_stop_a_run(tmp_path):
    (tmp_path / "status.json").write_text("[1, 2")
    with RunFolder(tmp_path) as place:
        place.write_status("running", PROGRESS)
        assert read_status(tmp_path)["state"] == "running"
