"""The decks take their pictures and numbers from the notebooks, and load nothing from other
servers."""

import re
from pathlib import Path

import pytest
import slides

ROOT = Path(__file__).resolve().parents[2]
DECKS = sorted((ROOT / "docs/teaching/slides").glob("week_*.md"))


@pytest.fixture(scope="module")
def chapters():
    return slides.Chapters(ROOT / "notebooks")


@pytest.mark.parametrize("deck", DECKS, ids=lambda d: d.stem)
def test_every_picture_and_number_of_a_deck_is_in_the_notebooks(deck, chapters, tmp_path):
    text = slides.prepare(deck, chapters, tmp_path).read_text(encoding="utf-8")
    assert "cell:" not in text
    assert not re.search(r"\{\{\d\d/", text)
    for alt, name in re.findall(r"!\[([^\]]*)\]\(([^)]+)\)", text):
        assert (tmp_path / name).stat().st_size > 500
        assert len(re.sub(r"^w:\d+ ", "", alt).split()) >= 4, (
            f"{deck.name}: {alt!r} says too little"
        )


def test_what_is_missing_is_named(chapters, tmp_path):
    deck = tmp_path / "week_9.md"
    for text, said in (
        (
            "![a](cell:02/nothing)",
            "cell nothing of chapter 2 shows no picture|cell nothing of chapter 02",
        ),
        ("![a](cell:77/q01)", "no chapter 77"),
        ("{{00/q10: frame 1: {} new}}", "must name one number"),
    ):
        deck.write_text(text)
        with pytest.raises(ValueError, match=said):
            slides.prepare(deck, chapters, tmp_path / "out")
