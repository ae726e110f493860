"""Recordings that do not say everything: questions at a terminal, and a sentence where there is
none."""

import os
from pathlib import Path

import numpy as np
import pytest

from gsfusion_nb.cli import main
from gsfusion_nb.cli.convert import mappable
from gsfusion_nb.data import SequenceError, open_sequence


@pytest.fixture
def scan(shared_sequence, tmp_path, monkeypatch):
    """Eight frames of a real recording in folders of other names, without poses or intrinsics."""
    source = tmp_path / "scan"
    mini = shared_sequence("redkitchen_mini48")
    for kind, name in (("rgb", "color"), ("depth", "depth"), ("depth", "depth_raw")):
        (source / name).mkdir(parents=True)
        for file in sorted((mini / kind).iterdir())[:8]:
            (source / name / file.name).write_bytes(file.read_bytes())
    monkeypatch.chdir(tmp_path)
    return source


@pytest.fixture
def terminal(monkeypatch):
    """``terminal(*answers)``: somebody answers; the list of prompts."""

    def at(*answers):
        asked = []
        answers = list(answers)
        monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
        monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
        monkeypatch.setattr("builtins.input", lambda prompt: asked.append(prompt) or answers.pop(0))
        return asked

    return at


def test_one_question_at_a_time(scan, terminal, capsys):
    asked = terminal("2", "nowhere.txt", "none", "265.7")
    folder, tracked = mappable(str(scan))
    assert asked == ["--depth ", "--poses ", "--poses ", "--intrinsics "]
    assert tracked
    text = capsys.readouterr().out
    assert "Which of these is depth?\n  1: depth/*.jpg" not in text
    assert "  2: depth_raw/*.png" in text
    assert "nowhere.txt does not exist" in text
    sequence = open_sequence(folder, poses=False).source
    assert (len(sequence), sequence.camera.fx) == (8, 265.7)
    assert mappable(str(scan)) == (folder, True)
    again = capsys.readouterr().out
    assert "was converted to" in again
    notes = [line for line in text.splitlines() if line.lstrip().startswith("note: ")]
    assert notes
    assert [line.strip() for line in again.splitlines()[1:]] == [line.strip() for line in notes]


def test_a_recording_that_has_changed_is_not_taken_from_its_conversion(scan, terminal, capsys):
    terminal("2", "none", "265.7")
    folder, _ = mappable(str(scan))
    later = (Path(folder) / "conversion.json").stat().st_mtime + 5
    for name in ("check-scan.html", ".DS_Store"):
        file = scan / name
        file.write_text("")
        os.utime(file, (later, later))
    assert mappable(str(scan)) == (folder, True)
    image = next(p for p in sorted(scan.rglob("*.png")))
    os.utime(image, (later, later))
    with pytest.raises(SequenceError, match="has changed since") as refused:
        mappable(str(scan))
    assert str(image) in str(refused.value)
    assert folder in str(refused.value)


def test_nobody_is_asked_without_a_terminal(scan, monkeypatch, capsys):
    monkeypatch.setattr("builtins.input", lambda prompt: pytest.fail("asked"))
    assert main(["map", str(scan)]) == 1
    said = capsys.readouterr().err
    assert "depth/*.png, depth_raw/*.png that may be depth; give --depth" in said
    assert f"gsfusion-nb convert {scan} converted/scan --depth ..." in said
    for options, missing in (
        (["--depth", "depth"], "--poses none"),
        (["--depth", "depth", "--poses", "none"], "--intrinsics"),
    ):
        assert main(["convert", str(scan), "out", *options]) == 1
        assert missing in capsys.readouterr().err


def test_what_can_be_opened_is_not_converted(shared_sequence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("redkitchen_mini48", "rgbd_dataset_freiburg1_xyz_excerpt"):
        source = str(shared_sequence(name))
        assert mappable(source) == (source, False)
    assert mappable("room") == ("room", False)
    assert not any(tmp_path.iterdir())


def test_another_recording_of_the_same_name(scan, terminal, tmp_path):
    terminal("1", "none", "265.7")
    mappable(str(scan))
    other = tmp_path / "elsewhere/scan"
    other.parent.mkdir()
    scan.rename(other)
    with pytest.raises(SequenceError, match="converted/scan is another recording"):
        mappable(str(other))
    np.testing.assert_equal((tmp_path / "converted/scan/poses.txt").exists(), False)


@pytest.mark.parametrize(
    ("name", "says"), [("a.svo2", "ZED_SVO_Export"), ("mav0/cam0/data.csv", "without depth")]
)
def test_a_program_whose_recordings_are_not_read_is_named(tmp_path, monkeypatch, name, says):
    """Also by map and check, and not as a folder of no known layout."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "scan" / name
    file.parent.mkdir(parents=True)
    file.write_bytes(bytes(64))
    source = file if file.suffix == ".svo2" else tmp_path / "scan"
    with pytest.raises(SequenceError, match=says):
        mappable(str(source))
    assert not (tmp_path / "converted").exists()
