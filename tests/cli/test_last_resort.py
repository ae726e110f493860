"""Whatever goes wrong, a command ends in one sentence, and the traceback is in a file."""

import re
from pathlib import Path

import pytest

from gsfusion_nb import cli
from gsfusion_nb.cli import map
from gsfusion_nb.recordings import fetch


def broken(arguments):
    return {}["deep inside"]


def text_for_a_number(arguments):
    return float("abc")


def recursing(arguments):
    return recursing(arguments)


@pytest.mark.parametrize("work", [broken, text_for_a_number, recursing])
def test_a_mistake_of_ours_is_one_sentence_with_a_log(tmp_path, capsys, monkeypatch, work):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(map, "run", work)
    status = cli.main(["map", "scan", "--out", "run"])
    said = capsys.readouterr()
    assert (status, said.out) == (1, "")
    assert said.err.startswith("gsfusion-nb map: ended by an unexpected error")
    assert said.err.count("\n") == 1
    (name,) = re.findall(r"the traceback is in (.*\.log)", said.err)
    log = Path(name)
    assert log.parent == tmp_path
    assert f"in {work.__name__}" in log.read_text()


def test_a_folder_without_permission_is_named_in_full(tmp_path, capsys, monkeypatch):
    def refused(arguments):
        raise PermissionError(13, "Permission denied", "runs")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(map, "run", refused)
    assert cli.main(["map", "room"]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"gsfusion-nb map: permission denied: {tmp_path / 'runs'}; expected")
    assert "--out" in said


def test_data_scripts_too(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert fetch.run("", lambda name: [][3], ["fr1_desk"], ["fr1_desk", "--yes"]) == 1
    assert "ended by an unexpected error, IndexError" in capsys.readouterr().err
    assert len(list(tmp_path.glob("*.log"))) == 1
