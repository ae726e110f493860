"""Progress is tqdm's bar; in a log, short work says nothing."""

import io

import pytest

from gsfusion_nb.progress import ProgressDisplay


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_on_a_terminal_it_is_a_bar():
    terminal = Terminal()
    with ProgressDisplay("mapping", unit="frame", stream=terminal) as progress:
        progress.show(1, total=4, note="PSNR 20.1 dB")
        progress.show(4, what="done")
    text = terminal.getvalue()
    assert "mapping" in text
    assert "4/4" in text


@pytest.mark.parametrize("shown", [True, False])
def test_short_work_is_kept_out_of_a_log(shown):
    log = io.StringIO()
    with ProgressDisplay("file", total=2, visible=shown, stream=log) as progress:
        assert list(progress.over("ab")) == ["a", "b"]
    assert log.getvalue() == ""
