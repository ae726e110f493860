"""What a run that goes on says: what it runs on now, and nothing of how it ended before."""

import json
from typing import Any

import pytest

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import gsfusion
from gsfusion_nb.runs import MappingRun, ran_on, resume_mapping, run_mapping
from gsfusion_nb.runs.run_folder import StopRequest
from gsfusion_nb.seeding import apply_rule, seeding_rule
from gsfusion_nb.types import Seeds

ROOM: dict[str, Any] = {"n_frames": 120, "width": 32, "height": 24}
SMALL: dict[str, Any] = {
    "tsdf__voxel_size_m": 0.1,
    "sh_degree": 0,
    "data__stop": 4,
    "data__hold_out_every": 0,
    "keyframe_min_seeds": 3,
    "optim__global_iterations": 1,
}


def stopped_after(frames: int, folder, monkeypatch, **changes):
    """A run that is asked to stop after some frames, without scores."""
    step = MappingRun._next_step

    def asked(run, source):
        taken = step(run, source)
        if len(run.steps) == frames:
            requests[0].wanted = True
        return taken

    requests: list[StopRequest] = []
    begin = StopRequest.__init__
    with monkeypatch.context() as patch:
        patch.setattr(
            StopRequest,
            "__init__",
            lambda self: (begin(self), requests.append(self))[0],
        )
        patch.setattr(MappingRun, "_next_step", asked)
        return run_mapping(
            "room", gsfusion("room", **SMALL, **changes), folder=folder, evaluate=False, **ROOM
        )


def warnings_of(folder) -> list[str]:
    return json.loads((folder / "metrics.json").read_text())["warnings"]


@pytest.mark.ci
def test_another_backend_or_version_is_said_in_the_terminal_the_numbers_and_the_report(
    tmp_path, monkeypatch, caplog
):
    run = stopped_after(2, tmp_path / "out", monkeypatch)
    assert json.loads((run.folder / "metrics.json").read_text())["ran_on"]["backend"] == "auto"
    monkeypatch.setattr(ran_on, "__version__", "9.9")
    caplog.clear()
    with use_backend("reference"):
        again = resume_mapping(tmp_path / "out")
    said = [
        w
        for w in warnings_of(again.folder)
        if "after 2 frames and 0 passes the run continued with" in w
    ]
    assert len(said) == 1
    assert "gsfusion_nb 9.9 instead of" in said[0]
    assert "backend reference instead of auto" in said[0]
    assert said[0] in caplog.messages
    assert "backend reference instead of auto" in (again.folder / "report.html").read_text()
    assert again.run.status == "complete"


def test_the_same_program_says_nothing_and_endings_are_forgotten(tmp_path, monkeypatch):
    """After two frames without a seed the map is empty; after four it is not, and no word of that
    is left."""

    @seeding_rule
    def late(ctx):
        """Seeds from the third frame on."""
        return (
            apply_rule("uniform", ctx, {"fraction": 0.2})
            if ctx.frame.index > 1
            else Seeds.empty(ctx.frame.depth_m)
        )

    run = stopped_after(2, tmp_path / "out", monkeypatch, seeding__rule="late", seeding__options={})
    said = warnings_of(run.folder)
    assert [sentence.partition(":")[0] for sentence in said] == [
        "interrupted after 2 of 4 frames and 0 global passes; everything mapped so far is saved",
        "the map has no Gaussians",
    ]
    again = resume_mapping(tmp_path / "out")
    assert len(again.mapper.gaussians) > 10
    assert warnings_of(again.folder) == []
    assert "no Gaussians" not in (again.folder / "report.html").read_text()


def test_endings_of_checkpoints_that_did_not_tell_them_apart_are_forgotten(tmp_path, monkeypatch):
    run = stopped_after(2, tmp_path / "out", monkeypatch).run
    state = run.state_dict()
    del state["endings"]
    run.load_state_dict(state)
    run.warnings.go_on()
    assert run.warnings == []
