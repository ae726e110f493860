"""A system in a file on the command line: mapped, scored, continued, repeated and compared. Its
code is executed only where the user names the file."""

import io
import json
import shlex
from unittest.mock import Mock

import pytest
from box_room import Box
from toy_system import SOURCE, write_toy

from gsfusion_nb.cli import main
from gsfusion_nb.compare import run_all
from gsfusion_nb.compare.admission import Admission
from gsfusion_nb.compare.recording_specs import recording_specs
from gsfusion_nb.compare.studies import StudyOptions, study_specs
from gsfusion_nb.compare.sweep import SweepOptions
from gsfusion_nb.mapping import systems
from gsfusion_nb.runs import rescore, resume_mapping, run_mapping
from gsfusion_nb.runs.system_of_run import code_of_system
from gsfusion_nb.seeding.named_code import SystemNotNamedError
from gsfusion_nb.seeding.rule import keep_registered

SIZE = ("--data.width", "48", "--data.height", "36", "--reader", "n_frames=60")
SMALL = (*SIZE, "--data.stop", "12")
SET = ("data.width=48", "data.height=36", "data.stop=12")


@pytest.fixture(autouse=True)
def own_registries(monkeypatch):
    """What a test loads is not known to the next."""
    monkeypatch.setattr(systems, "_NAMES", dict(systems._NAMES))
    monkeypatch.setattr(run_all, "admission", Mock(return_value=Admission()))
    with keep_registered():
        yield


@pytest.fixture
def toy(tmp_path):
    return write_toy(tmp_path / "mine")


@pytest.fixture
def run(toy, tmp_path):
    """The folder of a finished run that is not scored."""
    folder = tmp_path / "run"
    typed = ["map", "room", "--system", toy, *SMALL, "--out", str(folder)]
    assert main([*typed, "--no-evaluate"]) == 0
    return folder


def document(folder, name="metrics.json"):
    return json.loads((folder / name).read_text())


def refusal(arguments, capsys):
    """What is said where nobody can be asked."""
    capsys.readouterr()
    assert main(arguments) == 1
    return capsys.readouterr().err.strip()


def test_map_and_eval(toy, tmp_path, capsys, monkeypatch):
    run = tmp_path / "run"
    assert main(["map", "room", "--system", toy, *SMALL, "--out", str(run)]) == 0
    about = document(run, "config.json")
    assert (about["system"], about["system_from_file"], about["rule"]) == ("Toy", True, "toy_grid")
    assert (run / "system.py").read_text() == SOURCE
    assert (run / "system_modules/toy_helper.py").is_file()
    assert "Toy of one file on room" in (run / "report.html").read_text()
    scores = document(run)["metrics"]
    assert scores["psnr_mapped_db"] > 5
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    own = f"{run / 'system.py'}:Toy"
    said = refusal(["eval", str(run)], capsys)
    assert "asks for the system 'Toy' in" in said
    assert said.endswith(shlex.join(["gsfusion-nb", "eval", str(run), "--system", own]))
    for named in (own, toy):
        assert main(["eval", str(run), "--system", named]) == 0
    assert document(run)["warnings"] == []
    assert document(run)["metrics"] == scores
    said = refusal(["locate", str(run), "room"], capsys)
    assert said.endswith(shlex.join(["locate", str(run), "room", "--system", own]))
    assert main(["export", str(run), str(tmp_path / "map.ply")]) == 0  # needs no code
    write_toy(tmp_path / "mine", SOURCE + "# an edit\n")
    said = refusal(["eval", str(run), "--system", toy], capsys)
    assert "is not the system with which the run in" in said
    (run / "system.py").unlink()
    assert "mapped by the system 'Toy' in a file, and its source" in refusal(
        ["eval", str(run), "--system", own], capsys
    )


def test_the_settings_of_a_run_repeat_it(run, tmp_path, capsys, monkeypatch):
    again = tmp_path / "again"
    config = run / "config.json"
    typed = ["map", "room", "--from-config", str(config), "--reader", "n_frames=60"]
    typed += ["--no-evaluate", "--out", str(again)]
    named = ["--system", f"{run / 'system.py'}:Toy"]
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    assert refusal(typed, capsys).endswith(shlex.join(["gsfusion-nb", *typed, *named]))
    assert main([*typed, *named]) == 0
    assert document(again)["sha256"] == document(run)["sha256"]
    assert "leave out --system" in refusal([*typed, "--system", "gsfusion"], capsys)


def test_another_system_than_that_of_the_run_is_refused(run, toy, capsys):
    with pytest.raises(ValueError, match="is not the system with which the run"):
        rescore(run, system="gsfusion")
    built_in = document(run, "config.json") | {"system": "gsfusion", "system_from_file": False}
    (run / "config.json").write_text(json.dumps(built_in))
    said = refusal(["eval", str(run), "--system", toy], capsys)
    assert "was mapped by the system 'gsfusion', not by" in said
    unknown = built_in | {"system": "egg", "system_package": "egg-box 1.0"}
    (run / "config.json").write_text(json.dumps(unknown))
    said = refusal(["eval", str(run)], capsys)
    assert "the system 'egg', which is not known here; install the package that adds it" in said
    assert "'egg-box 1.0'" in said


@pytest.fixture
def interrupted(toy, tmp_path, monkeypatch):
    """The folder of a run that was interrupted in its third frame."""
    folder = tmp_path / "interrupted"
    system = systems.get_system(toy)
    original = system.map_frame

    def stops(self, frame):
        if frame.index == 2:
            raise KeyboardInterrupt
        return original(self, frame)

    config = system.preset("room", data__width=48, data__height=36, data__stop=5)
    code_of_system(system(config))  # before its code is patched
    with monkeypatch.context() as patch:
        patch.setattr(system, "map_frame", stops)
        with pytest.raises(KeyboardInterrupt) as end:
            run_mapping("room", config, folder=folder, evaluate=False, n_frames=60)
    return folder, end.value.__notes__


def test_resume(interrupted, toy, tmp_path, capsys, monkeypatch):
    folder, notes = interrupted
    own = f"{folder / 'system.py'}:Toy"
    rule = f"{folder / 'rule.py'}:toy_grid"
    command = ["map", "--resume", str(folder)]
    named = ["--seeding.rule", rule, "--system", own]
    assert notes[-1].endswith(shlex.join(["gsfusion-nb", *command, *named]))
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    typed = shlex.join(["gsfusion-nb", *command, "--no-evaluate", "--system", own])
    assert refusal([*command, "--no-evaluate"], capsys).endswith(typed)
    with pytest.raises(SystemNotNamedError, match="resume_mapping"):
        resume_mapping(folder)
    said = refusal([*command, "--system", "rtg_slam"], capsys)
    assert "leave out" in said
    assert main([*command, "--no-evaluate", "--system", own]) == 0  # its rule is in the same file
    whole = tmp_path / "whole"
    again = ["map", "room", "--system", toy, *SIZE, "--data.stop", "5", "--no-evaluate"]
    assert main([*again, "--out", str(whole)]) == 0
    assert document(folder)["sha256"] == document(whole)["sha256"]


def test_a_run_does_not_go_on_with_another_module_beside_its_system(interrupted, capsys):
    folder, _ = interrupted
    checkpoint = "system_modules/toy_helper.py"
    (folder / checkpoint).write_text("EVERY_PX = 7\n")
    said = refusal(["map", "--resume", str(folder), "--system", f"{folder}/system.py:Toy"], capsys)
    assert "the system 'Toy' is not as it was when" in said
    assert "different: file toy_helper, code or values as loaded. Restore it" in said


def test_sweep_and_study_and_keys(toy, tmp_path):
    options = SweepOptions(set=SET, reader=("n_frames=60",), system=toy)
    plain = recording_specs({"toy": {"system": toy}}, options, "room")[0]
    assert (plain.system_name, plain.rule_name, plain.system_source) == ("Toy", "toy_grid", SOURCE)
    assert "system: file of the system" in (plain.code or {})
    moved = write_toy(tmp_path / "elsewhere")
    same = recording_specs({"toy": {"system": moved}}, options, "room")[0]
    assert (same.key, same.from_json(same.to_json()).key) == (plain.key, plain.key)
    (tmp_path / "elsewhere/toy_helper.py").write_text("EVERY_PX = 7\n")
    edited = recording_specs({"toy": {"system": moved}}, options, "room")[0]
    assert edited.key != plain.key
    study = StudyOptions(name="systems", set=SET, reader=("n_frames=60",))
    labels = [spec.label for spec in study_specs("systems", study, "room", "given", toy)]
    assert labels == ["GSFusion, given", "RTG-SLAM, given", "GPS-SLAM, given", "Toy of one file"]
    labels = [spec.label for spec in study_specs("systems", study, "room", "", toy)]
    assert labels[-2:] == ["Toy of one file, given", "Toy of one file, tracked"]


def test_a_study_without_variants_of_systems_refuses_one(toy, capsys):
    for name in ("views", "roofline"):
        said = refusal(["study", name, "room", "--system", toy], capsys)
        assert said.endswith(f"the study {name} takes no other system; leave out --system")


def test_benchmark_and_lab(toy, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Box().replica(tmp_path / "data/room0")
    typed = ["benchmark", "replica", "data", "--systems", "mine/toy.py:Toy", "--out", "bench"]
    assert main([*typed, "--set", "data.stop=3"]) == 0
    assert "| **Toy of one file, here** |" in (tmp_path / "bench/benchmark.md").read_text()
    (tmp_path / "table.toml").write_text(
        'system = "mine/toy.py:Toy"\nseeds = 1\n[settings]\n"data.stop" = 6\n"data.width" = 48\n'
        '"data.height" = 36\n[[rules]]\nrule = "uniform"\n[[scenes]]\ndata = "room"\n'
        "reader = { n_frames = 60 }\n"
    )
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    said = refusal(["lab", "table.toml"], capsys)
    assert said.endswith("gsfusion-nb lab table.toml --system-file mine/toy.py")
    assert main(["lab", "table.toml", "--system-file", "mine/toy.py", "--out", "lab"]) == 0
    assert (tmp_path / "lab/runs.csv").read_text().count(",Toy,") == 1
