import json
import os
import subprocess
import sys

import pytest

from gsfusion_nb.cli import doctor, main
from gsfusion_nb.runs import scores

SMALL = (
    "--data.width 80 --data.height 60 --data.stop 6 --data.hold-out-every 3 "
    "--data.hold-out-offset 1"
)
FAST = (
    "--tsdf.voxel-size-m 0.04 --optim.global-iterations 1 --optim.keyframe-iterations 2 "
    "--sh-degree 0 --seeding.quadtree-threshold 0.01 --keyframe-min-seeds 20"
)


def test_map_then_eval_then_repeat_from_its_config(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(scores, "SURFACE_SAMPLES", 4_000)
    out = tmp_path / "run"
    assert main(["map", "room", *SMALL.split(), *FAST.split(), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "Novel views (held out)" in text
    assert "gaussians.ply" in text
    config = json.loads((out / "config.json").read_text())["config"]
    assert config["tsdf"]["voxel_size_m"] == 0.04
    assert config["data"]["stop"] == 6

    before = json.loads((out / "metrics.json").read_text())["metrics"]
    assert main(["eval", str(out)]) == 0
    after = json.loads((out / "metrics.json").read_text())["metrics"]
    assert after == before

    again = [
        "map",
        "room",
        "--from-config",
        str(out / "config.json"),
        "--out",
        str(tmp_path / "again"),
        "--no-evaluate",
    ]
    assert main(again) == 0
    repeated = json.loads((tmp_path / "again" / "metrics.json").read_text())["metrics"]
    assert repeated["n_gaussians"] == before["n_gaussians"]


def test_preset_is_a_start_that_options_override(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["map", "room", "--preset", "tum", "--fidelity", "code", "--help"])
    assert stop.value.code == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "--optim.global-iterations" in text
    assert "(default: 20)" in text
    assert "--help-all" in text
    assert "--optim.lr-xyz" not in text
    assert text.count(" --") < 50


@pytest.mark.parametrize(
    ("arguments", "status", "sentence"),
    [
        (["map", "nowhere"], 1, "nowhere is not a folder; expected one that holds a sequence"),
        (["map"], 1, "expected the folder of a sequence"),
        (["map", "room", "--preset", "repilca"], 1, "no preset 'repilca'; known:"),
        (
            ["map", "room", "--memory-gb", "1", "--device", "cuda"],
            1,
            "--memory-gb is for maps on a processor",
        ),
        (["map", "room", "--backend", "nubma"], 1, "no backend 'nubma'; known:"),
        (
            ["map", "--resume", "nowhere"],
            1,
            "nowhere does not exist; expected the folder of an interrupted run",
        ),
        (["eval", "nowhere"], 1, "config.json"),
        (["bench", "fly"], 1, "no bench 'fly'"),
        (["bench", "tsdf", "--data", "nowhere"], 1, "nowhere is not a folder"),
        (["fly"], 2, "no command 'fly'"),
    ],
)
def test_mistakes_are_answered_with_a_sentence(arguments, status, sentence, capsys):
    assert main(arguments) == status
    assert sentence in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.parametrize(
    "arguments", [["map", "room"], ["demo"], ["live", "folder", "nowhere", "--no-poses"]]
)
def test_the_environment_chooses_the_backend_where_no_option_does(arguments, monkeypatch, capsys):
    monkeypatch.setenv("GSFUSION_BACKEND", "nubma")
    assert main(arguments) == 1
    assert "no backend 'nubma'; known:" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "value", "sentence"),
    [
        ("--tsdf.voxel-sise-m", "0.1", "voxel-size-m"),
        ("--tsdf.voxel-size-m", "-1", "tsdf.voxel_size_m must be"),
    ],
)
def test_a_bad_option_is_refused(option, value, sentence, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["map", "room", option, value])
    assert stop.value.code == 2
    assert sentence in capsys.readouterr().err


def test_doctor_warm_compiles_ahead(monkeypatch):
    monkeypatch.setattr(doctor, "warm", lambda: 7)  # make setup and test_warm.py compile
    assert main(["doctor", "--warm"]) == 7


@pytest.mark.skipif(os.name == "nt", reason="needs a POSIX pipe")
@pytest.mark.parametrize("arguments", [["--help"], ["course"]])
def test_a_reader_that_has_enough_ends_the_command_quietly(arguments, tmp_path):
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "gsfusion_nb", *arguments]
    environment = {**os.environ, "GSNB_COURSE_FILE": str(tmp_path / "course.json")}
    done = subprocess.run(
        command,
        stdout=write,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")


def test_ctrl_c_while_the_command_imports_is_one_line(tmp_path):
    """Not a traceback, also in a library; of an error that is none of the user's doing there is
    one."""
    (tmp_path / "torch.py").write_text("raise KeyboardInterrupt")
    code = "import sys; sys.argv[0] = '/usr/bin/{}'; import gsfusion_nb.cli"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}

    def said(command: str) -> str:
        done = subprocess.run(
            [sys.executable, "-c", code.format(command)],
            env=environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode != 0
        return done.stderr

    assert said("gsfusion-nb") == "gsfusion-nb: interrupted\n"
    assert "Traceback" in said("python")
    (tmp_path / "torch.py").write_text("raise RuntimeError('broken')")
    assert "RuntimeError: broken" in said("gsfusion-nb")
