"""A rule from a file on the command line: its source goes into the run folder; a resumed or
repeated run uses it."""

import json

import pytest

from gsfusion_nb.cli.map import run
from gsfusion_nb.errors import SequenceError
from gsfusion_nb.mapping import GSFusion
from gsfusion_nb.runs import resume_mapping, run_mapping

RULE = "def near(ctx, *, step=5):\n    return ctx.seeds_at(ctx.pixels()[::step], 1.0)\n"
FAST = (
    "--data.width",
    "32",
    "--data.height",
    "24",
    "--data.stop",
    "4",
    "--reader",
    "n_frames=20",
    "--no-evaluate",
    "--sh-degree",
    "0",
    "--tsdf.voxel-size-m",
    "0.1",
    "--optim.global-iterations",
    "0",
)


@pytest.fixture
def rule(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(RULE)
    return path


def hashes(folder):
    return json.loads((folder / "metrics.json").read_text())["sha256"]


def test_the_source_goes_into_the_folder_and_repeats_the_run(rule, tmp_path, capsys):
    first = tmp_path / "first"
    again = tmp_path / "again"
    options = ("--seeding.rule", f"{rule}:near", "--rule-options", "step=7")
    assert run(["room", *FAST, *options, "--out", str(first)]) == 0
    assert (first / "rule.py").read_text() == RULE
    written = json.loads((first / "config.json").read_text())
    assert (written["rule"], written["config"]["seeding"]["options"]) == ("near", {"step": 7})
    rule.write_text("an edit that is not even Python")
    config = (
        "--from-config",
        str(first / "config.json"),
        "--no-evaluate",
        "--reader",
        "n_frames=20",
        "--seeding.rule",
        f"{first / 'rule.py'}:near",
    )
    assert run(["room", *config, "--out", str(again)]) == 0
    assert hashes(again) == hashes(first)


def test_a_resumed_run_uses_its_own_rule_or_refuses_another(rule, tmp_path, monkeypatch):
    from gsfusion_nb.config import gsfusion

    config = gsfusion(
        "room",
        data__width=32,
        data__height=24,
        data__stop=4,
        sh_degree=0,
        tsdf__voxel_size_m=0.1,
        optim__global_iterations=0,
        seeding__rule=f"{rule}:near",
    )
    folder = tmp_path / "run"
    original = GSFusion.step

    def dies(self, frame):
        if frame.index == 2:
            raise MemoryError("full")
        return original(self, frame)

    with monkeypatch.context() as patch:
        patch.setattr(GSFusion, "step", dies)
        with pytest.raises(MemoryError):
            run_mapping("room", config, folder=folder, evaluate=False, n_frames=20)
    assert (folder / "rule.py").read_text() == RULE
    rule.write_text(RULE.replace("step=5", "step=6"))
    with pytest.raises(SequenceError, match="is not the seeding rule with which the run in"):
        resume_mapping(folder, seeding=f"{rule}:near", evaluate=False)
    finished = resume_mapping(folder, seeding=f"{folder / 'rule.py'}:near", evaluate=False)
    assert finished.run.status == "complete"
    assert not [w for w in finished.run.warnings if "another seeding rule" in w]
