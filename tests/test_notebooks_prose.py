"""What the notebooks' text says about results holds for the stored outputs; times add up."""

import ast
import json
import re
from pathlib import Path

import pytest
from claims import claims_of, failures, main

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
EACH = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)


def notebook(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


def prose(path: Path) -> str:
    cells = notebook(path)["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


def page(comment: str, shown: str) -> dict:
    """A notebook of one code cell, which shows something, and one text cell with a comment."""
    output = {"output_type": "stream", "name": "stdout", "text": shown.splitlines(keepends=True)}
    return {
        "cells": [
            {"id": "run", "cell_type": "code", "source": [], "outputs": [output]},
            {
                "id": "text",
                "cell_type": "markdown",
                "source": [f"It gains.\n\n<!-- holds\n{comment}\n-->"],
            },
        ]
    }


SHOWN = (
    "held-out PSNR  20.63 -> 22.96 dB\n37,097 Gaussians, difference -2e-4, left 20%\nrow 1\nrow 2\n"
)


@EACH
def test_what_the_text_says_about_results_holds(path):
    assert failures(notebook(path)) == []


@pytest.mark.parametrize(
    "comment",
    [
        "run: held-out PSNR {before} -> {after} dB\nafter - before > 2\nafter - before < 3",
        "run: {n} Gaussians, difference {d}, left {share}%\nn == 37097\nabs(d) < 1e-3 and 10 < "
        "share <= 20",
        "run: PSNR {} -> {after}\nnot after < 20 or max(after, 2) == 2",
    ],
)
def test_what_is_true_holds(comment):
    assert failures(page(comment, SHOWN)) == []


@pytest.mark.parametrize(
    ("comment", "said"),
    [
        ("run: PSNR {a} -> {b} dB\nb - a > 3", "'b - a > 3'"),
        ("run: SSIM {a}\na > 0", "SSIM"),
        ("run: row {a}\na > 0", "2 times"),
        ("other: row {a}\na > 0", "'other'"),
        ("run: row 1\nb > 0", "'b'"),
        ("run: PSNR {a}\na + 1", "compares nothing"),
        ("run: PSNR {a}\na >", "'a >'"),
    ],
)
def test_what_is_not_shown_or_cannot_be_read_is_told(comment, said):
    assert said in "\n".join(failures(page(comment, SHOWN)))


def test_a_comment_that_compares_nothing_is_refused():
    with pytest.raises(ValueError, match="compares nothing"):
        claims_of(page("run: PSNR {a}", SHOWN))


def test_the_command_lists_what_does_not_hold(tmp_path, caplog):
    path = tmp_path / "a.ipynb"
    path.write_text(json.dumps(page("run: PSNR {a} -> {b} dB\nb < a", SHOWN)))
    assert main([str(path)]) == 1
    assert "says 'b < a'" in caplog.text


@EACH
def test_the_time_of_a_chapter_covers_its_exercises(path):
    text = prose(path)
    told = re.search(r"\*\*Time\*\* \|.*?(\d+) minutes", text)
    assert told, f"{path.name} does not tell its time in minutes"
    exercises = [int(minutes) for minutes in re.findall(r"★[★☆]* \((\d+) minutes\)", text)]
    assert int(told[1]) >= 1.2 * sum(exercises), (
        f"{sum(exercises)} minutes of exercises, and the text to read"
    )


@EACH
def test_every_picture_says_what_it_shows(path):
    """``show`` takes its words from the labels or from alt, ``show_figure`` from the figure;
    ``Image`` has none."""
    for cell in notebook(path)["cells"]:
        if cell["cell_type"] != "code":
            continue
        for call in ast.walk(ast.parse("".join(cell["source"]))):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name):
                assert call.func.id != "Image", (
                    f"{path.name}, cell {cell['id']}: use show or show_figure"
                )
                said = len(call.args) > 1 or "alt" in [keyword.arg for keyword in call.keywords]
                assert call.func.id != "show" or said, (
                    f"{path.name}, cell {cell['id']}: give show labels or alt"
                )


@EACH
def test_every_stored_picture_has_words(path):
    """A widget's picture too: screen readers of the stored chapter get them from the output's
    metadata."""
    for cell in notebook(path)["cells"]:
        for output in cell.get("outputs", []):
            for kind in {"image/png", "image/jpeg"} & set(output.get("data", {})):
                said = output.get("metadata", {}).get(kind, {}).get("alt", "")
                assert len(said) > 5, f"{path.name}, cell {cell['id']}: a picture without words"
            tags = re.findall(
                r"<(?:img|svg)[^>]*>", "".join(output.get("data", {}).get("text/html", ""))
            )
            for tag in tags:
                assert re.search(r'(alt|aria-label)="[^"]+|aria-hidden', tag), (
                    f"{path.name}, {cell['id']}: {tag[:80]}"
                )
