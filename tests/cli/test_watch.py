"""``--watch``: who may look, and that the tab ends with the run or stays."""

import socket

import pytest

from gsfusion_nb.cli import main
from gsfusion_nb.viz import BrowserTab

ROOM = ["--reader", "n_frames=120", "--data.width", "80", "--data.height", "60"]
SMALL = ["--data.stop", "2", "--tsdf.voxel-size-m", "0.05", "--optim.global-iterations", "0"]
RUN = ["map", "room", *ROOM, *SMALL, "--no-evaluate"]


def _free_port() -> str:
    with socket.socket() as trial:
        trial.bind(("127.0.0.1", 0))
        return str(trial.getsockname()[1])


def test_the_address_is_said_and_the_tab_stays_until_it_is_ended(tmp_path, monkeypatch, capsys):
    pytest.importorskip("viser", reason="the extra watch is not installed")
    waited = []
    monkeypatch.setattr(BrowserTab, "wait", lambda tab: waited.append(tab.port))
    monkeypatch.setattr("webbrowser.open", lambda url: pytest.fail("a browser was opened"))
    monkeypatch.setattr("gsfusion_nb.cli.watch._has_desktop", lambda: False)
    port = _free_port()
    watch = ["--watch", "--watch-port", port]
    assert main([*RUN, "--out", str(tmp_path / "stays"), *watch]) == 0
    said = capsys.readouterr().err
    assert f"http://127.0.0.1:{port} (only programs on this machine can open it)" in said
    assert "until Ctrl-C" in said
    assert len(waited) == 1
    assert main([*RUN, "--out", str(tmp_path / "ends"), *watch, "--no-watch-stays"]) == 0
    assert len(waited) == 1


def test_options_of_the_tab_without_it_are_refused(tmp_path, capsys):
    assert main([*RUN, "--out", str(tmp_path / "run"), "--watch-host", "0.0.0.0"]) == 1
    assert "--watch-host is for the tab that --watch opens" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
