"""Lines where the output goes to a file, one every ten seconds and one at the end; a bar on a terminal."""

import io

import pytest

from gsfusion_nb.work import ProgressDisplay


class Clock:
    """Shows the seconds that the test says."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_line_every_ten_seconds_and_one_at_the_end(clock):
    log = io.StringIO()
    with ProgressDisplay("mapping", total=2000, unit="frame", stream=log, clock=clock) as progress:
        for n in range(1, 2001):
            clock.now_s = 0.02 * n
            progress.show(n, note=f"PSNR {20 + n / 1000:.1f} dB")
    assert "\r" not in log.getvalue()
    lines = log.getvalue().splitlines()
    assert lines[0] == "mapping: 500 of 2,000 frames (25 %), 10 s; PSNR 20.5 dB"
    assert lines[-1] == "mapping: 2,000 of 2,000 frames (100 %), 40 s; PSNR 22.0 dB"
    assert len(lines) == 4


def test_short_work_is_one_line(clock):
    log = io.StringIO()
    with ProgressDisplay("fitting", total=1, unit="image", stream=log, clock=clock) as progress:
        assert list(progress.over("a")) == ["a"]
    assert log.getvalue() == "fitting: 1 of 1 image (100 %), 0 s\n"


def test_the_last_line_is_there_after_an_error_too(clock):
    log = io.StringIO()

    def convert():
        with ProgressDisplay("converting", total=9, unit="frame", stream=log, clock=clock) as progress:
            for i in progress.over(range(9)):
                if i == 4:
                    raise RuntimeError("torn")

    with pytest.raises(RuntimeError, match="torn"):
        convert()
    assert log.getvalue() == "converting: 4 of 9 frames (44 %), 0 s\n"


def test_bytes_and_an_unknown_total(clock):
    log = io.StringIO()
    with ProgressDisplay("scene.zip", unit="B", stream=log, clock=clock) as progress:
        clock.now_s = 12
        progress.show(1_500_000)
        clock.now_s = 30
        progress.show(2_600_000_000, total=3_000_000_000)
    assert log.getvalue().splitlines() == ["scene.zip: 1.5 MB, 12 s", "scene.zip: 2.6 GB of 3.0 GB (87 %), 30 s"]


def test_work_that_goes_on_and_work_that_is_not_to_be_shown(clock):
    log = io.StringIO()
    with ProgressDisplay("mapping", total=60, unit="frame", done=30, stream=log, clock=clock) as progress:
        progress.show(31, what="mapping again")
    with ProgressDisplay("hidden", total=3, shown=False, stream=log) as progress:
        list(progress.over(range(3)))
    assert log.getvalue() == "mapping again: 31 of 60 frames (52 %), 0 s\n"


def test_on_a_terminal_it_is_a_bar():
    terminal = Terminal()
    with ProgressDisplay("mapping", unit="frame", stream=terminal) as progress:
        progress.show(1, total=4, note="PSNR 20.1 dB")
        progress.show(4, what="done")
    text = terminal.getvalue()
    assert "\r" in text
    assert "mapping" in text
    assert "4/4" in text


@pytest.mark.parametrize(("seconds", "lines"), [(1.0, 0), (11.0, 2)])
def test_short_work_that_leaves_nothing_is_kept_out_of_a_log(seconds, lines):
    log, now = io.StringIO(), [0.0]
    with ProgressDisplay("file", total=2, leave=False, stream=log, clock=lambda: now[0]) as progress:
        now[0] = seconds
        progress.show(1)
        progress.show(2)
    assert len(log.getvalue().splitlines()) == lines
