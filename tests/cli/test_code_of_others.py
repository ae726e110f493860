"""Code that a file of somebody else's names is executed only where the user names it, or says yes
on a terminal."""

import io
import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from gsfusion_nb import cli
from gsfusion_nb.cli import main
from gsfusion_nb.cli.run_settings import read_settings
from gsfusion_nb.compare.table_file import read_table
from gsfusion_nb.config import GSFusionConfig, from_dict, from_run, gsfusion, to_dict
from gsfusion_nb.errors import SequenceError
from gsfusion_nb.mapping import GSFusion
from gsfusion_nb.runs import resume_mapping, run_mapping
from gsfusion_nb.runs.resume import load_run
from gsfusion_nb.seeding.named_code import RuleNotNamedError

RULE = "def near(ctx, *, step=5):\n    return ctx.seeds_at(ctx.pixels()[::step], 1.0)\n"
HELPER = "STEP = 5\n"
SPY = "import pathlib\npathlib.Path({place!r}).touch()\n"
"""What shows that code was executed."""
FAST = {
    "data__width": 32,
    "data__height": 24,
    "data__stop": 4,
    "sh_degree": 0,
    "tsdf__voxel_size_m": 0.1,
    "optim__global_iterations": 0,
}


class Terminal(io.StringIO):
    """Standard input on which somebody types."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def ran(tmp_path):
    """The file that is there once the rule's code was executed."""
    return tmp_path / "ran"


@pytest.fixture
def stranger(tmp_path, ran, monkeypatch):
    """The folder of a run of a rule in a file, interrupted after two of four frames; nothing of it
    is loaded here."""
    own = tmp_path / "mine" / "my_rule.py"
    own.parent.mkdir()
    own.write_text(SPY.format(place=str(ran)) + "import thin\n" + RULE)
    own.with_name("thin.py").write_text(HELPER)
    folder = tmp_path / "their run"
    original = GSFusion.step

    def interrupted(self, frame):
        if frame.index == 2:
            raise KeyboardInterrupt
        return original(self, frame)

    config = gsfusion("room", **FAST, seeding__rule=f"{own}:near")
    with monkeypatch.context() as patch:
        patch.setattr(GSFusion, "step", interrupted)
        with pytest.raises(KeyboardInterrupt) as end:
            run_mapping("room", config, folder=folder, evaluate=False, n_frames=20)
    named = shlex.join(
        [
            "gsfusion-nb",
            "map",
            "--resume",
            str(folder),
            "--seeding.rule",
            f"{folder / 'rule.py'}:near",
        ]
    )
    assert any(note.endswith(named) for note in end.value.__notes__)
    assert (folder / "rule_modules/thin.py").read_text() == HELPER
    # another module than the one that is loaded
    (folder / "rule.py").write_text(own.read_text() + "# theirs\n")
    ran.unlink()
    return folder


def test_a_run_of_others_is_not_executed(stranger, ran, capsys, monkeypatch):
    file = stranger / "rule.py"
    for resume in (load_run, resume_mapping):
        with pytest.raises(
            RuleNotNamedError, match="asks for the seeding rule 'near' in"
        ) as refused:
            resume(stranger)
        assert f"seeding='{file}:near'" in str(refused.value)
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    for words in (["--resume", str(stranger)], ["--resume", str(stranger), "--no-evaluate"]):
        assert main(["map", *words]) == 1
        said = capsys.readouterr().err
        assert str(file) in said
        assert said.strip().endswith(
            shlex.join(["gsfusion-nb", "map", *words, "--seeding.rule", f"{file}:near"])
        )
    monkeypatch.setattr("sys.stdin", Terminal("\n"))
    assert main(["map", "--resume", str(stranger)]) == 1
    assert "Execute it now? [y/N]" in capsys.readouterr().err
    assert not ran.exists()


def test_a_named_file_is_compared_before_it_is_executed(stranger, ran, tmp_path):
    (tmp_path / "other.py").write_text(RULE)
    with pytest.raises(SequenceError, match="is not the seeding rule with which the run in"):
        resume_mapping(stranger, seeding=f"{tmp_path / 'other.py'}:near")
    assert not ran.exists()
    with pytest.raises(SequenceError, match=r"not as it was when .* began; different: "):
        # named, but altered since the checkpoint
        resume_mapping(stranger, seeding=f"{stranger / 'rule.py'}:near")
    assert ran.exists()


@pytest.mark.parametrize("way", ["the option", "an answer"])
def test_one_s_own_run_goes_on(stranger, tmp_path, capsys, monkeypatch, way):
    own = tmp_path / "mine" / "my_rule.py"
    (stranger / "rule.py").write_text(own.read_text())
    monkeypatch.setattr("sys.stdin", Terminal("y\n"))
    named = ["--seeding.rule", f"{own}:near"] if way == "the option" else []
    assert main(["map", "--resume", str(stranger), "--no-evaluate", *named]) == 0
    assert ("Execute it now?" in capsys.readouterr().err) == (way == "an answer")
    assert json.loads((stranger / "metrics.json").read_text())["status"] == "complete"


def settings_file(place, rule="near", **more):
    document = {
        "system": "gsfusion",
        "rule": "near",
        "config": to_dict(gsfusion("room", **FAST)),
        **more,
    }
    document["config"]["seeding"]["rule"] = rule
    (place / "config.json").write_text(json.dumps(document))
    return place / "config.json"


@pytest.mark.parametrize("way", ["a file beside it", "a path in the settings"])
@pytest.mark.parametrize("command", [["map", "room"], ["live", "folder", "nowhere"]])
def test_settings_of_others_execute_nothing(tmp_path, ran, capsys, monkeypatch, way, command):
    (tmp_path / "rule.py").write_text(SPY.format(place=str(ran)) + RULE)
    beside = way == "a file beside it"
    if beside:
        file = settings_file(tmp_path, rule_from_file=True)
    else:
        file = settings_file(tmp_path, rule=f"{tmp_path}/rule.py:near")
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    typed = [*command, "--from-config", str(file)]
    assert main(typed) == 1
    named = shlex.join(["gsfusion-nb", *typed, "--seeding.rule", f"{tmp_path / 'rule.py'}:near"])
    assert capsys.readouterr().err.strip().endswith(named)
    with pytest.raises(SystemExit):
        main([*typed, "--help"])
    assert not ran.exists()
    assert read_settings(file, rule="uniform").seeding.rule in ("near", "uniform")


def test_settings_in_python_name_no_file(tmp_path):
    values = to_dict(gsfusion("room")) | {"seeding": {"rule": f"{tmp_path}/rule.py:near"}}
    for read in (from_run, from_dict):
        with pytest.raises(
            ValueError, match=r"seeding\.rule must be the name of a rule, got the file"
        ):
            read(GSFusionConfig, values)


def test_eval_and_export_execute_nothing(tmp_path, ran, capsys):
    (tmp_path / "rule.py").write_text(SPY.format(place=str(ran)) + RULE)
    for rule in ("near", f"{tmp_path}/rule.py:near"):
        settings_file(
            tmp_path, rule, rule_from_file=True, source={"path_or_name": "room"}, device="cpu"
        )
        (tmp_path / "metrics.json").write_text('{"metrics": {}}')
        assert main(["eval", str(tmp_path)]) == 1
        assert main(["export", str(tmp_path), str(tmp_path / "out.glb")]) == 1
    assert not ran.exists()


TABLE = (
    '[[rules]]\nrule = "uniform"\n[[rules]]\nrule = "their.py:near"\n[[scenes]]\ndata = "room"\n'
)


def test_the_table_of_a_comparison_executes_nothing(tmp_path, ran, capsys, monkeypatch):
    file = tmp_path / "their.py"
    table = tmp_path / "table.toml"
    file.write_text(SPY.format(place=str(ran)) + RULE)
    table.write_text(TABLE)
    with pytest.raises(RuleNotNamedError, match="rule_files="):
        read_table(table)
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    assert main(["lab", str(table)]) == 1
    named = shlex.join(["gsfusion-nb", "lab", str(table), "--rule-file", str(file)])
    assert capsys.readouterr().err.strip().endswith(named)
    (tmp_path / "unrelated.py").write_text(RULE)
    assert main(["lab", str(table), "--rule-file", str(tmp_path / "unrelated.py")]) == 1
    assert not ran.exists()
    assert main(["lab", str(table), "--rule-file", str(file), "--reference", "nobody"]) == 1
    assert ran.exists()


def test_a_path_with_signs_of_a_terminal_is_shown_as_it_is():
    error = RuleNotNamedError("run", ["\x1b[2K/safe.py:near"], "-")
    assert "\x1b" not in error.wish
    assert "\\x1b[2K" in error.wish


def test_the_path_that_is_shown_is_the_one_that_would_be_executed():
    error = RuleNotNamedError("run", ["~/rule.py:near"], "-")
    assert str(Path.home() / "rule.py") in error.wish
    assert "~" not in error.wish


COMMAND = """
import multiprocessing
from concurrent.futures import ProcessPoolExecutor

import gsfusion_nb.cli as cli


def main():
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(int, "7").result()


if __name__ == "__main__":
    cli.main = main
    cli.end_process = print
    cli.program()
"""
"""A program that is installed outside of the folder in which it is started."""


def test_processes_of_a_command_import_nothing_from_the_folder_it_is_started_in(
    tmp_path, ran, monkeypatch
):
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    started_in = tmp_path / "recording"
    started_in.mkdir()
    (started_in / "pickle.py").write_text(SPY.format(place=str(ran)))
    (tmp_path / "command.py").write_text(COMMAND)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "command.py"), "lab"],
        capture_output=True,
        text=True,
        check=False,
        cwd=started_in,
    )
    assert done.stdout.strip() == "7", done.stderr
    assert not ran.exists()


def test_jupyter_still_imports_what_is_beside_a_notebook(monkeypatch):
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    monkeypatch.setattr(cli, "main", lambda: 0)
    monkeypatch.setattr(cli, "end_process", lambda status: None)
    for command, value in (("course", None), ("lab", "1")):
        monkeypatch.setattr(sys, "argv", ["gsfusion-nb", command])
        cli.program()
        assert os.environ.get("PYTHONSAFEPATH") == value
    monkeypatch.delenv("PYTHONSAFEPATH")
