"""The marked places of the pages are filled from the files of numbers."""

import json

import pytest
from measuring.pages import fill, origin
from measuring.recipes import write_numbers


def test_pages_are_filled_from_the_file(project):
    assert [p.name for p in fill(project, write=True)] == ["README.md", "a.md"]
    page = (project / "docs/a.md").read_text()
    assert (
        "| one | 20.2 | 1.00 |\n| both | 21.0 ± 1.4 | 2.00 ± 0.00 |\n\nMeasured on 2026-01-01 with "
        "commit `" in page
    )
    assert "```\ngsfusion-nb map wall\n```\n" in page  # of one seed
    assert (
        "Best: <!-- text: walls best -->22.00 dB<!-- end -->."
        in (project / "README.md").read_text()
    )
    assert fill(project, write=False) == []
    (project / "docs/a.md").write_text(page.replace("20.2", "20.3"))  # by hand
    assert [p.name for p in fill(project, write=False)] == ["a.md"]


def test_folders_of_the_machine_are_left_out(tmp_path):
    found = {
        "data": "/home/me/my data/redkitchen250",
        "files": ["C:\\data\\kitchen", "~/data/desk/"],
        "reason": "ValueError: /home/me/data/desk/rgb.txt is missing",
        "cells": [
            "28.1 / 0.9 / 3",
            "held out, 1 / 6",
            "frames/s",
            "docs/measured/track_only.py",
            "https://a.b/c/d",
        ],
        "psnr_db": 20.5,
    }
    write_numbers(tmp_path / "walls.json", found)
    assert json.loads((tmp_path / "walls.json").read_text()) == found | {
        "data": "redkitchen250",
        "files": ["kitchen", "desk"],
        "reason": "ValueError: rgb.txt is missing",
    }


@pytest.mark.parametrize(
    ("quiet", "threads", "words"),
    [
        (True, 1, "`, with one thread."),
        (True, 2, "`, with 2 threads."),
        (False, 2, "`."),
    ],
)
def test_a_table_of_times_says_its_threads(quiet, threads, words):
    numbers = {"commit": "0123456789", "date": "2026-01-01", "machine": {"threads": threads}}
    assert origin("walls", numbers | {"quiet": quiet}).endswith(words)
