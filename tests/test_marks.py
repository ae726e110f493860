"""Every test is run by a command: what is marked ci or slow by .ci/run and by make campaign."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MARKED = re.compile(r"\bmark\.(ci|slow)\b")


def files_with(mark: str) -> set[str]:
    """Files of tests some of which have this mark."""
    files = {p: set(MARKED.findall(p.read_text("utf-8"))) for p in (ROOT / "tests").rglob("*.py")}
    return {p.relative_to(ROOT).as_posix() for p, marks in files.items() if mark in marks}


def campaign_commands() -> list[list[str]]:
    """What make campaign gives to pytest, by marks."""
    made = subprocess.run(
        ["make", "--dry-run", "campaign"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    lines = [
        line.split("-m pytest ", 1)[1] for line in made.stdout.splitlines() if "-m pytest " in line
    ]
    return [command for command in map(shlex.split, lines) if "-m" in command]


def ci_command() -> list[str]:
    """What .ci/run gives to pytest for the longer tests."""
    script = (ROOT / ".ci/run").read_text("utf-8")
    options = re.search(r"-m pytest -n .* (-m \"[^\"]+\") \"\$@\"", script)
    files = re.search(r"more_tests \$\((.+)\)$", script, re.MULTILINE)
    assert options
    assert files
    chosen = subprocess.run(
        ["bash", "-c", files[1]],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    return [*shlex.split(options[1]), *chosen.stdout.split()]


def runs(command: list[str], file: str, marks: set[str]) -> bool:
    """Whether a command of pytest runs a test of a file that has these marks and no other."""
    expression = command[command.index("-m") + 1]
    chosen = eval(expression, {mark: mark in marks for mark in ("ci", "slow")})
    places = [word for word in command if word.startswith("tests")] or ["tests"]
    ignored = [word.partition("=")[2] for word in command if word.startswith("--ignore=")]
    below = [
        any(f"{file}/".startswith(f"{place.rstrip('/')}/") for place in some)
        for some in (places, ignored)
    ]
    return bool(chosen) and below[0] and not below[1]


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_make_campaign_runs_every_slow_test():
    commands = campaign_commands()
    for marks in ({"slow"}, {"slow", "ci"}):
        left = [
            f
            for f in files_with("slow")
            if sum(runs(command, f, marks) for command in commands) != 1
        ]
        assert left == [], "each file once"


def test_ci_runs_every_test_that_is_marked_for_it():
    command = ci_command()
    assert [file for file in files_with("ci") if not runs(command, file, {"ci"})] == []


def test_marks_are_where_the_commands_look():
    """A mark in a conftest or plug-in would be of tests whose own files do not have the word."""
    elsewhere = [
        f for f in files_with("ci") | files_with("slow") if not Path(f).name.startswith("test_")
    ]
    assert elsewhere == []


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("-m slow", True),
        ("-m slow tests/recordings", True),
        ("-m slow tests/record", False),
        ("-m slow --ignore=tests/recordings", False),
        ("-m ci", False),
        ("-m 'ci and not slow'", False),
    ],
)
def test_what_a_command_runs(command, expected):
    assert (
        runs(shlex.split(command), "tests/recordings/checkup/test_breakages.py", {"slow"})
        == expected
    )
