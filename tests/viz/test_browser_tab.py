"""The map in a browser tab, by what its server holds; ``tests/browser`` opens it."""

import dataclasses
import socket
import sys
import time
from typing import Any

import numpy as np
import pytest
import torch

from gsfusion_nb.errors import ArgumentError
from gsfusion_nb.runs import run_mapping
from gsfusion_nb.types import GaussianParams
from gsfusion_nb.viz import BrowserTab, browser_tab, viser_rows
from gsfusion_nb.viz.browser_tab import WatchUnavailable


@pytest.fixture
def tab():
    pytest.importorskip("viser", reason="the extra watch is not installed")
    with BrowserTab(port=_free_port()) as tab:
        yield tab


def _free_port() -> int:
    with socket.socket() as trial:
        trial.bind(("127.0.0.1", 0))
        return trial.getsockname()[1]


def _until(happened, limit_s=60.0) -> None:
    end = time.monotonic() + limit_s
    while not happened() and time.monotonic() < end:
        time.sleep(0.02)
    assert happened()


@pytest.fixture
def mapped(make_run):
    """A mapper with two frames, the second frame and its report."""
    run = make_run(n=4)
    reports = run.online()
    next(reports)
    report = next(reports)
    return run.mapper, run.sequence.mapping[1], report


def test_the_scene_is_the_map_and_the_camera(tab, mapped):
    mapper, frame, report = mapped
    tab.frame_mapped(mapper, frame, report)
    _until(lambda: tab.n_updates == 1)
    assert set(tab._handles) == {"/map/0", "/path", "/camera"}
    n = len(mapper.gaussians)
    buffer = tab._handles["/map/0"].buffer
    assert buffer.shape == (n, 8)
    centres = np.ascontiguousarray(buffer[:, :3]).view(np.float32)
    assert np.array_equal(centres, mapper.gaussians.params.xyz_W.numpy())
    assert tuple(tab._handles["/camera"].position) == pytest.approx((0.04, 0.0, 0.0))
    assert "frame 1: " in tab._text.content
    assert tab._photo.image.shape == (240, 320, 3)
    assert tab.is_private
    assert tab.url == f"http://127.0.0.1:{tab.port}"


def test_only_the_part_that_changed_is_sent(tab, mapped, monkeypatch):
    mapper, frame, report = mapped
    monkeypatch.setattr(browser_tab, "CHUNK_ROWS", 32)
    monkeypatch.setattr(browser_tab, "UPDATE_S", 0.0)
    monkeypatch.setattr(browser_tab, "REST", 0.0)
    sent = []
    send = tab._send_chunk

    def noted(name, chunk):
        sent.append(name)
        send(name, chunk)

    monkeypatch.setattr(tab, "_send_chunk", noted)
    tab.frame_mapped(mapper, frame, report)
    _until(lambda: tab.n_updates == 1)
    n_chunks = -(-len(mapper.gaussians) // 32)
    assert sent == [f"/map/{k}" for k in range(n_chunks)]
    assert n_chunks > 2
    mapper.gaussians.params.xyz_W[40, 0] += 0.1
    tab.frame_mapped(mapper, frame, report)
    _until(lambda: tab.n_updates == 2)
    assert sent[n_chunks:] == ["/map/1"]
    monkeypatch.setattr(
        mapper.files, "standard_gaussians", lambda: mapper.gaussians.params[:20], raising=False
    )
    tab.frame_mapped(mapper, frame, report)
    _until(lambda: tab.n_updates == 3)
    assert [name for name in tab._handles if name.startswith("/map")] == ["/map/0"]


def test_updates_that_come_too_soon_are_left_out_but_the_last(tab, mapped, monkeypatch):
    mapper, frame, report = mapped
    copies = []

    def noted(params):
        copies.append(len(params))
        return viser_rows.rows_to_show(params)

    monkeypatch.setattr(browser_tab, "rows_to_show", noted)
    monkeypatch.setattr(browser_tab, "UPDATE_S", 3600.0)
    tab.frame_mapped(mapper, frame, report)
    _until(lambda: tab.n_updates == 1)
    for _ in range(5):
        tab.frame_mapped(mapper, frame, report)
    assert len(copies) == 1
    tab.finished(mapper, None, {"psnr_held_out_db": 31.25})
    _until(lambda: "finished" in tab._text.content)
    assert "31.2 dB" in tab._text.content


def test_a_large_map_is_thinned_and_a_broken_row_is_transparent(mapped, monkeypatch):
    params = mapped[0].gaussians.params
    few = viser_rows.rows_to_show(params)
    broken = dataclasses.replace(few, xyz_W=few.xyz_W.clone())
    broken.xyz_W[3, 1] = torch.nan
    records = viser_rows.records_of(broken)
    assert records["opacity"][3] == 0
    assert records["opacity"][2] > 0
    assert np.isfinite(records["xyz"]).all()
    monkeypatch.setattr(viser_rows, "MOST_ROWS", len(params) // 3)
    thin = viser_rows.rows_to_show(params)
    assert 0.15 * len(params) < len(thin) < 0.4 * len(params)
    shown = (params.xyz_W[:, None] == thin.xyz_W).all(-1).any(1)
    assert shown.sum() == len(thin)
    assert torch.equal(thin.xyz_W, params.xyz_W[shown])
    larger = (thin.log_scale - params.log_scale[shown]).exp()
    assert larger.min() > 3**0.5
    assert torch.allclose(larger, larger[0, 0].expand_as(larger))
    few = viser_rows.final_rows(params)
    assert 0.15 * len(params) < len(few) <= len(params) // 3


def wall_of_discs(n: int) -> GaussianParams:
    """n x n discs in a grid of 1 cm, as a surface is shown."""
    numbers = torch.arange(n * n)
    xyz_W = torch.stack([numbers // n, numbers % n, torch.zeros(n * n)], dim=1) * 0.01
    return GaussianParams(
        xyz_W=xyz_W.float(),
        log_scale=torch.tensor([0.006, 0.006, 0.001]).log().expand(n * n, 3).clone(),
        quat=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n * n, 4).clone(),
        opacity_logit=torch.full((n * n,), 3.0),
        sh=torch.zeros(n * n, 1, 3),
    )


@pytest.mark.parametrize("show", [viser_rows.rows_to_show, viser_rows.final_rows])
@pytest.mark.parametrize("share", [4, 8, 10])
def test_a_thinned_wall_has_no_holes(show, share, monkeypatch):
    n = 120
    monkeypatch.setattr(viser_rows, "MOST_ROWS", n * n // share)
    records = viser_rows.records_of(show(wall_of_discs(n)))
    assert len(records) < 1.1 * n * n / share
    places = (20 + 80 * torch.rand(2000, 2, generator=torch.Generator().manual_seed(0))) * 0.01
    offset = places[:, None] - torch.from_numpy(records["xyz"][:, :2].copy())
    inverse = torch.from_numpy(records["covariance"][:, :2, :2].astype(np.float32)).inverse()
    squared = torch.einsum("pni,nij,pnj->pn", offset, inverse, offset)
    alpha = torch.from_numpy(records["opacity"].astype(np.float32) / 255).T * (-squared / 2).exp()
    light_behind = (1 - alpha).prod(dim=1)
    assert light_behind.max() < 0.5
    assert light_behind.mean() < 0.1


def test_a_run_is_seen_from_the_first_frame_to_the_passes(tab, config, tmp_path, monkeypatch):
    words = []
    monkeypatch.setattr(browser_tab, "UPDATE_S", 0.0)
    monkeypatch.setattr(browser_tab, "REST", 0.0)
    show = tab._show
    monkeypatch.setattr(
        tab, "_show", lambda mapper, text, **more: (words.append(text), show(mapper, text, **more))
    )
    options: dict[str, Any] = {"n_frames": 120, "width": 80, "height": 60, "evaluate": False}
    run = run_mapping("room", config, folder=tmp_path / "run", watch=tab, **options)
    kinds = [word.split(",")[0].split(":")[0].split()[0] for word in words]
    n_frames = len(run.run.steps)
    assert kinds[:n_frames] == ["frame"] * n_frames
    assert set(kinds[n_frames:-1]) == {"optimising"}
    assert kinds[-1] == "finished"


def test_closing_shows_the_last_state_and_frees_the_port(mapped):
    pytest.importorskip("viser", reason="the extra watch is not installed")
    mapper, frame, report = mapped
    port = _free_port()
    with BrowserTab(port=port) as tab:
        tab.frame_mapped(mapper, frame, report)
        tab.finished(mapper, None, {})
    assert tab.n_updates >= 1
    assert "finished" in tab._text.content
    with BrowserTab(port=port) as again:
        assert again.port == port


def test_what_cannot_be_opened_is_said_with_what_to_do(monkeypatch):
    with pytest.raises(ArgumentError, match="between 1 and 65535, got 0"):
        BrowserTab(port=0)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(WatchUnavailable, match=r"pip install 'gsfusion-nb\[watch\]'"):
        BrowserTab()
    monkeypatch.undo()
    pytest.importorskip("viser", reason="the extra watch is not installed")
    with pytest.raises(WatchUnavailable, match=r"198\.51\.100\.7 is no address of this machine"):
        BrowserTab(host="198.51.100.7")


def test_who_can_open_it_is_said():
    pytest.importorskip("viser", reason="the extra watch is not installed")
    with BrowserTab(host="0.0.0.0", port=_free_port()) as tab:
        assert not tab.is_private
        assert "everyone whose device reaches this address" in tab.who_sees()
        assert "0.0.0.0" not in tab.url


def test_a_port_that_is_taken_gives_another_one():
    pytest.importorskip("viser", reason="the extra watch is not installed")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with BrowserTab(port=port) as tab:
            assert tab.port != port


def test_a_tab_that_fails_says_so_and_the_run_goes_on(tab, mapped, monkeypatch, caplog):
    mapper, frame, report = mapped
    monkeypatch.setattr(tab, "_send_camera", lambda moment: 1 / 0)
    tab.frame_mapped(mapper, frame, report)
    _until(lambda: "not updated any more: division by zero" in caplog.text)
    tab.finished(mapper, None, {})
