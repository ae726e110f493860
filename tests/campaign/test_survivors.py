"""The list of mutants that may survive names lines of the program as it is; without Cosmic Ray."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))
import mutants


def has_lines(path: Path, text: str) -> bool:
    """Whether some successive lines of a file, joined without indentation, are ``text``."""
    lines = [" ".join(line.split()) for line in path.read_text("utf-8").splitlines()]
    for start in range(len(lines)):
        joined = lines[start]
        for line in lines[start + 1 :]:
            if len(joined) >= len(text):
                break
            joined = f"{joined} {line}"
        if joined == text:
            return True
    return False


def stale_entries(root: Path) -> list[str]:
    """Entries whose file or line is not in a checkout."""
    return [
        f"{file}: {original}"
        for file, original, _ in mutants.entries()
        if not (root / file).is_file() or not has_lines(root / file, original)
    ]


def test_every_listed_survivor_is_a_line_of_its_file():
    """A line that is gone or has moved to another file takes its entry with it."""
    assert stale_entries(mutants.ROOT) == []


def test_a_line_that_is_gone_makes_its_entry_stale(tmp_path):
    for file in {file for file, _, _ in mutants.entries()}:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text((mutants.ROOT / file).read_text("utf-8"), "utf-8")
    assert stale_entries(tmp_path) == []
    file, original, _ = next(iter(mutants.entries()))
    text = (tmp_path / file).read_text("utf-8")
    (tmp_path / file).write_text(text.replace(original, f"{original} + 1"), "utf-8")
    assert stale_entries(tmp_path) == [f"{file}: {original}"]
    (tmp_path / file).unlink()
    assert f"{file}: {original}" in stale_entries(tmp_path)


def test_lines_that_are_one_statement_are_found_together(tmp_path):
    path = tmp_path / "a.py"
    path.write_text("a = 1\nb = f(\n    a,\n)\n")
    assert has_lines(path, "b = f( a, )")
    assert not has_lines(path, "a,  )")
