"""Whatever goes wrong, a command ends in one sentence, and the traceback is in a file."""

import errno
import os
import re
import subprocess
import sys
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


@pytest.mark.parametrize(
    ("number", "what"),
    [
        (errno.EACCES, "permission denied"),
        (errno.EPERM, "permission denied"),
        (errno.EROFS, "the file system is read-only"),
    ],
)
def test_a_folder_that_may_not_be_written_is_named_in_full(
    tmp_path, capsys, monkeypatch, number, what
):
    def refused(arguments):
        raise OSError(number, "what the system says", "runs")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(map, "run", refused)
    assert cli.main(["map", "room"]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"gsfusion-nb map: {what}: {tmp_path / 'runs'}; expected")
    assert "--out" in said


def test_a_terminal_that_knows_few_letters(tmp_path):
    """On a terminal of cp1252 a path in another script is written with escapes."""
    folder = tmp_path / "звук"
    environment = os.environ | {"PYTHONIOENCODING": "cp1252"}
    command = [sys.executable, "-m", "gsfusion_nb", "check", str(folder)]
    done = subprocess.run(command, capture_output=True, env=environment)
    assert done.returncode == 1
    assert b"\\u0437\\u0432\\u0443\\u043a" in done.stderr
    assert b"Traceback" not in done.stderr


def test_data_scripts_too(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert (
        fetch.run(
            "",
            lambda name: [][3],
            ["fr1_desk"],
            ["fr1_desk", "--yes"],
        )
        == 1
    )
    assert "ended by an unexpected error, IndexError" in capsys.readouterr().err
    assert len(list(tmp_path.glob("*.log"))) == 1
