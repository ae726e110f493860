"""The page of the demo while it works: pictures, loaded again, and gone unless a report came."""

import pytest

from gsfusion_nb.viz import growing_page
from gsfusion_nb.viz.growing_page import GrowingPage


@pytest.fixture
def path(tmp_path):
    return tmp_path / "report.html"


def test_it_is_there_at_once_and_shows_the_newest_frame(path, make_run, monkeypatch):
    monkeypatch.setattr(growing_page, "EVERY_S", 0.0)
    run = make_run(n=3)
    with GrowingPage(path, "A <room>") as page:
        first = path.read_text(encoding="utf-8")
        assert "A &lt;room&gt;" in first
        assert 'http-equiv="refresh"' in first
        assert "<img src" not in first
        run.watchers.append(page)
        for report in run.online():
            text = path.read_text(encoding="utf-8")
            assert f"GSFusion, frame {report.frame_index + 1}: " in text
            assert text.count("<img src") == 3
    assert not path.exists()


def test_frames_that_come_too_soon_are_not_drawn(path, make_run, monkeypatch):
    monkeypatch.setattr(growing_page, "EVERY_S", 3600.0)
    run = make_run(n=3)
    with GrowingPage(path, "room") as page:
        run.watchers.append(page)
        list(run.online())
        assert "GSFusion, frame 1: " in path.read_text(encoding="utf-8")


def test_a_report_in_its_place_stays(path):
    with GrowingPage(path, "room"):
        path.write_text("the report", encoding="utf-8")
    assert path.read_text(encoding="utf-8") == "the report"
