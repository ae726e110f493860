"""The process that compiles beside the demo: started only where there is something to compile, and
ended with it."""

import pytest

from gsfusion_nb.backends import use_backend
from gsfusion_nb.cli import compile_ahead
from gsfusion_nb.cli.compile_ahead import CompileAhead


class Process:
    """Stands for the other process."""

    def __init__(self):
        self.ended: list[str] = []

    def terminate(self) -> None:
        self.ended.append("terminate")

    def wait(self) -> None:
        self.ended.append("wait")


@pytest.fixture
def started(monkeypatch):
    """Commands of processes that were started, and the processes."""
    processes: list[tuple[list[str], Process]] = []

    def start(command, **_options):
        processes.append((command, Process()))
        return processes[-1][1]

    monkeypatch.setattr(compile_ahead.subprocess, "Popen", start)
    return processes


def test_it_ends_with_the_demo(started, monkeypatch):
    monkeypatch.setattr(compile_ahead, "is_compiled", lambda name: False)
    with use_backend("auto"), CompileAhead():
        ((command, process),) = started
        assert command[-1].endswith("import compile_all; compile_all()")
        assert process.ended == []
    assert process.ended == ["terminate", "wait"]


def test_nothing_is_started_where_nothing_is_to_be_compiled(started, monkeypatch):
    monkeypatch.setattr(compile_ahead, "is_compiled", lambda name: True)
    with use_backend("auto"), CompileAhead():
        pass
    monkeypatch.setattr(compile_ahead, "is_compiled", lambda name: False)
    with use_backend("reference"), CompileAhead():
        pass
    assert started == []
