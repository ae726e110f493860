"""Messages: one line, and never longer than a reader's patience."""

import ast
from pathlib import Path

import gsfusion_nb
from gsfusion_nb.checks import shown
from gsfusion_nb.errors import (
    ArgumentError,
    BadFrameError,
    DiskFullError,
    ForeseenError,
    KindError,
    MemoryFullError,
    SequenceError,
    SequenceNotFoundError,
    UnknownNameError,
)
from gsfusion_nb.recordings.unpack import ArchiveError


def test_values_of_others_are_shown_short():
    assert shown("rgb/0.png") == "'rgb/0.png'"
    assert shown(None) == "None"
    assert shown([1, 2.5, "x"]) == "[1, 2.5, 'x']"
    for value in (
        "a" * 10**6,
        b"a" * 10**6,
        list(range(10**6)),
        {"a": "b" * 1000},
        10**200,
        "\n" * 500,
    ):
        text = shown(value)
        assert len(text) <= 120
        assert "\n" not in text
        assert text.endswith("...")


def test_sentences_have_one_line_and_a_limit():
    for kind in (SequenceError, SequenceNotFoundError, BadFrameError, ArchiveError):
        assert str(kind("a.txt is empty")) == "a.txt is empty"
        text = str(kind(f"scan/{'a' * 5000}\n{'b' * 5000}.png does not exist; expected an image"))
        assert len(text) <= 1000
        assert "\n" not in text
        assert text.startswith("scan/aaa")
        assert text.endswith("bb.png does not exist; expected an image")


PACKAGE = Path(gsfusion_nb.__file__).parent
PLAIN = ("ValueError", "TypeError", "KeyError", "MemoryError", "RuntimeError", "Exception")


def test_what_the_package_raises_is_foreseen():
    """The command line shows a ``ForeseenError`` as one line; a plain ``ValueError`` would look
    like a mistake of the program."""
    plain_errors = []
    for path in sorted(PACKAGE.rglob("*.py")):
        if (PACKAGE / "kernels") in path.parents:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                names = [ast.unparse(node.exc.func)]
                refused = names[0] in PLAIN[:4]
            elif isinstance(node, ast.ClassDef) and path.name != "errors.py":
                names = [ast.unparse(base) for base in node.bases]
                refused = bool(names) and set(names) <= set(PLAIN)
            else:
                continue
            if refused:
                plain_errors.append(f"{path.relative_to(PACKAGE)}:{node.lineno} {names}")
    assert plain_errors == []


def test_foreseen_errors_are_still_the_kinds_of_python():
    """What catches ``ValueError`` catches ours, and a ``KeyError`` shows its text as it is."""
    for kind, plain in (
        (ArgumentError, ValueError),
        (KindError, TypeError),
        (UnknownNameError, KeyError),
        (MemoryFullError, MemoryError),
        (DiskFullError, OSError),
        (SequenceError, ValueError),
    ):
        assert issubclass(kind, plain)
        assert issubclass(kind, ForeseenError)
    assert str(UnknownNameError("no rule 'x'; known: 'a'")) == "no rule 'x'; known: 'a'"
