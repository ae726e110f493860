"""The learner's clock: pauses, kernels that start again, two notebooks, older files, and the switch that stops it."""

import json
from types import SimpleNamespace

import pytest

from gsfusion_nb.teaching import clock, predict, progress
from gsfusion_nb.teaching.clock import add, named_in, working_s
from gsfusion_nb.teaching.course import read_course
from gsfusion_nb.teaching.progress import note, read_section


class Shell:
    """The events of a notebook's kernel, with its wall clock."""

    def __init__(self, monkeypatch):
        self.at, self.events, self.callbacks = 1e9, self, {}
        for name in ("GSNB_VIEW", "GSNB_SMOKE", "GSNB_COURSE_TIMES"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setitem(clock.sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: self))
        monkeypatch.setattr(clock, "now", lambda: self.at)
        monkeypatch.setattr(progress, "_said", set())
        self.monkeypatch = monkeypatch

    def register(self, event, callback):
        self.callbacks[event] = callback

    def restart(self, chapter):
        """A new kernel, in which the first cell of a chapter runs."""
        for name, value in (("_chapter", None), ("_noted", -clock.MERGED_S), ("_cell", "")):
            self.monkeypatch.setattr(clock, name, value)
        clock.start(chapter, ("psnr", "first_seen", "slope"))

    def cell(self, source, *, after_s, takes_s=0.0):
        """A cell that runs some time after the last one ended."""
        self.at += after_s
        self.callbacks["pre_run_cell"](SimpleNamespace(raw_cell=source))
        self.at += takes_s
        self.callbacks["post_run_cell"](None)

    @property
    def seconds(self):
        """Chapter or exercise -> seconds of work."""
        return {name: working_s(entry) for name, entry in read_section("times").items() if name != "clock"}


@pytest.fixture
def shell(tmp_path, monkeypatch):
    monkeypatch.setenv("GSNB_COURSE_FILE", str(tmp_path / "course.json"))
    return Shell(monkeypatch)


def test_time_before_a_cell_is_its_time_until_the_exercise_is_solved(shell, capsys):
    shell.restart(0)
    assert "in your own course file only" in capsys.readouterr().out
    shell.cell("x = 1", after_s=100)
    shell.cell("def psnr(a, b):\n    ...", after_s=200)
    shell.cell("check.psnr(psnr)", after_s=400, takes_s=3)
    note("exercises", "psnr", passed="now")
    shell.cell("f = check.first_seen.working(first_seen); check.psnr(psnr)", after_s=50)
    shell.cell("y = psnr(1, 2)", after_s=1200)  # a pause
    shell.cell("z = 1", after_s=10**6)  # days
    assert shell.seconds == {"chapter 0": 753.0, "psnr": 603.0}
    assert read_section("times")["psnr"] == {"seconds": 203.0, "gaps_s": [400]}
    assert working_s(read_section("times")["chapter 0"], 3600.0) == 753 + 1200
    assert (read_course().chapters[0].minutes_worked, read_course().chapters[1].minutes_worked) == (13, 0)


def test_a_kernel_starts_again_and_two_notebooks_share_one_clock(shell, capsys):
    shell.restart(0)
    shell.cell("a", after_s=60)
    shell.at += 30
    shell.restart(5)  # the learner goes on with another chapter half a minute later
    shell.cell("check.slope.hint()", after_s=20)
    shell.at += 100
    predict("p", "Which?", [1, 2]).answer(1)
    assert shell.seconds == {"chapter 0": 60.0, "chapter 5": 150.0, "slope": 20.0}
    assert capsys.readouterr().out.count("in your own course file only") == 1
    shell.at -= 5000  # somebody sets the computer's clock
    shell.cell("b", after_s=0)
    shell.cell("c", after_s=10)
    assert shell.seconds["chapter 5"] == 160.0
    for _ in range(100):  # all cells at once
        shell.cell("d", after_s=0.1)
    assert shell.seconds["chapter 5"] == pytest.approx(170, abs=2.5)


@pytest.mark.parametrize("how", ["GSNB_COURSE_TIMES=off", "GSNB_VIEW=static", "GSNB_SMOKE=1", "switch"])
def test_a_clock_that_is_off_notes_nothing(shell, how, monkeypatch, capsys):
    if how == "switch":
        clock.switch("off")
    else:
        monkeypatch.setenv(*how.split("="))
    shell.restart(0)
    shell.cell("a", after_s=60)
    assert shell.seconds == {}
    assert capsys.readouterr().out == ""
    assert "last" not in read_section("times").get("clock", {})


def test_the_switch_and_older_or_edited_files(shell, tmp_path):
    (tmp_path / "course.json").write_text(json.dumps({"format": 1, "exercises": {"psnr": {"tries": 2}}}))
    shell.restart(0)
    shell.cell("check.psnr(psnr)", after_s=60)
    assert shell.seconds["psnr"] == 60
    clock.switch("off")
    shell.cell("a", after_s=60)
    clock.switch("on")
    shell.cell("b", after_s=60)
    shell.cell("c", after_s=60)
    assert shell.seconds["chapter 0"] == 120  # not while it was off
    clock.switch("forget")
    assert shell.seconds == {}
    assert read_section("exercises") == {"psnr": {"tries": 2}}
    edited = {"clock": {"last": 0}, "a": {"seconds": "many", "gaps_s": 3}, "b": {"seconds": -1, "gaps_s": ["x", 500]}}
    assert [working_s(edited[name]) for name in "ab"] == [0, 500]
    add(edited, 60.0, ["a", "b"])
    assert [working_s(edited[name]) for name in "ab"] == [60, 559]


def test_cells_that_name_an_exercise():
    source = "def psnr(a):\n    ...\ncheck.slope.hint(); x = check.first_seen.working(x); check.psnr(psnr); undef y("
    assert named_in(source) == ["psnr", "slope"]
