"""Rows on their way to the browser: what a record holds, and that the changes sent add up to the
map."""

import dataclasses

import numpy as np
import pytest
import torch

from gsfusion_nb.types import GaussianParams
from gsfusion_nb.viewer.splat_rows import layout_for, pack_rows, packet_between


def random_map(n, generator, harmonics=4):
    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    return GaussianParams(
        xyz_W=3 * normal(n, 3),
        log_scale=normal(n, 3) - 4,
        quat=normal(n, 4),
        opacity_logit=2 * normal(n),
        sh=0.3 * normal(n, harmonics, 3),
    )


@pytest.mark.parametrize("n", [0, 1, 7])
def test_round_trip(n, generator):
    params = random_map(n, generator)
    columns = np.arange(2 * n, dtype=np.float32).reshape(n, 2)
    layout = layout_for(params, 2)
    rows = pack_rows(params, columns, layout).reshape(-1).view(layout.dtype)
    assert len(rows) == n
    assert (rows["xyz_W"] == params.xyz_W.numpy()).all()
    assert (rows["columns"] == columns).all()
    for name, value in (
        ("quat", params.quat),
        ("log_scale", params.log_scale),
        ("sh", params.sh),
        ("opacity", params.opacity_logit.sigmoid()),
    ):
        np.testing.assert_allclose(
            rows[name].astype(np.float32),
            value.numpy(),
            rtol=2**-11,
            atol=1e-6,
        )  # float16


def test_rows_with_nan_or_infinity_are_hidden_and_keep_their_place(generator):
    params = random_map(4, generator)
    xyz = params.xyz_W.clone()
    sh = params.sh.clone()
    xyz[1, 2] = float("nan")
    sh[3, 0, 0] = float("inf")
    layout = layout_for(params, 0)
    bad = dataclasses.replace(params, xyz_W=xyz, sh=sh)
    rows = pack_rows(bad, np.zeros((4, 0), np.float32), layout).reshape(-1).view(layout.dtype)
    assert (rows["opacity"] > 0).tolist() == [True, False, True, False]
    assert np.isfinite(rows["xyz_W"]).all()
    assert np.isfinite(rows["sh"]).all()


def test_huge_maps_leave_the_higher_harmonics_at_home(generator, monkeypatch):
    params = random_map(100, generator, harmonics=16)
    assert layout_for(params, 1).harmonics == 16
    monkeypatch.setattr("gsfusion_nb.viewer.splat_rows.PACKET_BYTES", 100 * 100)
    layout = layout_for(params, 1)
    assert layout.harmonics == 9
    rows = pack_rows(params, np.zeros((100, 1), np.float32), layout)
    assert rows.shape == (100, layout.stride)


def packed(params):
    return pack_rows(
        params,
        np.zeros((len(params), 0), np.float32),
        layout_for(params, 0),
    )


def applied(old, packet, n):
    """What the front end holds after the packet, of ``n`` rows."""
    index, records = packet
    if index is None:
        return records
    out = np.zeros((n, records.shape[1]), np.uint8)
    out[: len(old)] = old
    out[index] = records
    return out


def test_changed_rows_travel_and_unchanged_ones_do_not(generator):
    params = random_map(50, generator)
    moved = params.xyz_W.clone()
    moved[[3, 17]] += 0.01
    old = packed(params)
    new = packed(dataclasses.replace(params, xyz_W=moved))
    packet = packet_between(old, new)
    assert packet is not None
    assert np.asarray(packet[0]).tolist() == [3, 17]
    assert (applied(old, packet, len(new)) == new).all()
    assert packet_between(new, new) is None


def test_everything_travels_where_parts_are_no_cheaper(generator):
    params = random_map(50, generator)
    old = packed(params)
    nothing = packed(params[:0])
    other = (
        packed(params[5:]),
        packed(random_map(50, generator)),
        packed(random_map(50, generator, harmonics=1)),
    )
    for before, new in (*((old, new) for new in other), (None, old), (old, nothing)):
        packet = packet_between(before, new)
        assert packet is not None
        assert packet[0] is None
        assert packet[1] is new
