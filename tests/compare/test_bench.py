"""The bench end to end on a handful of values: its scene, its table, its options."""

import json
import sys

import pytest
import torch
from toy_system import write_toy

from gsfusion_nb.compare.bench import BenchOptions, raster, run, volume
from gsfusion_nb.compare.bench.growth import growth_rows
from gsfusion_nb.compare.bench.mapper import STAGES
from gsfusion_nb.compare.bench.options import SECTIONS, BenchRow
from gsfusion_nb.compare.bench.scene import random_scene
from gsfusion_nb.compare.bench.timing import Lap, summary
from gsfusion_nb.geometry import project, se3
from gsfusion_nb.mapping import SYSTEMS
from gsfusion_nb.render import project_gaussians, render
from gsfusion_nb.render.constants import ALPHA_MIN
from gsfusion_nb.resources import PeakMemory


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(raster, "COUNTS", (200, 300))
    monkeypatch.setattr(raster, "SIZES", ((64, 48),))
    monkeypatch.setattr(volume, "VOXEL_SIZES_M", (0.08, 0.04))
    monkeypatch.setattr(BenchOptions, "budget_s", 0.0)


@pytest.mark.ci
def test_all_sections(small, tmp_path, capsys):
    path = tmp_path / "bench.json"
    options = BenchOptions(
        quick=True,
        frames=2,
        size=("64x48",),
        json=str(path),
    )
    assert run.main(options) == 0
    text = capsys.readouterr().out
    tables = [line for line in text.splitlines() if line.startswith("|")]
    assert {line.count("|") for line in tables} == {9}
    numbers = json.loads(path.read_text())
    assert (numbers["interrupted"], numbers["machine"]["threads"]) == (False, 1)
    rows = {
        name: [row for row in numbers["rows"] if row["section"] == name]
        for name in options.sections
    }
    assert all(rows.values())
    assert "numba" in {row["method"] for row in rows["raster"]}
    for row in rows["raster"]:
        assert row["timing"]["wall_ms"] > 0
    fused = [row["values"] for row in rows["tsdf"] if "blocks" in row["values"]]
    assert all(values["blocks"] == fused[0]["blocks"] > 0 for values in fused)
    assert any(row["case"].endswith(" / raycast") for row in rows["tsdf"])
    whole = next(row for row in rows["map"] if " / " not in row["case"])
    assert whole["timing"]["wall_ms"] == pytest.approx(1e3 / whole["values"]["frames_per_second"])
    stages = [row["case"].partition(" / ")[2] for row in rows["map"]]
    assert stages[: 1 + len(STAGES)] == ["", *STAGES.values()]


@pytest.mark.ci
def test_growth(tmp_path, capsys):
    path = tmp_path / "bench.json"
    assert (
        run.main(
            BenchOptions(
                what="growth",
                quick=True,
                size=("64x48",),
                json=str(path),
            )
        )
        == 0
    )
    rows = json.loads(path.read_text())["rows"]
    # rooms 1, 2 and 4
    assert [row["method"] for row in rows] == [name for name in SYSTEMS for _ in range(3)]
    for name in SYSTEMS:
        sizes = [row["values"]["n_gaussians"] for row in rows if row["method"] == name]
        assert sizes == sorted(sizes)
        exponents = [row["values"].get("exponent") for row in rows if row["method"] == name]
        assert exponents[:-1] == [None, None]
        last = [row for row in rows if row["method"] == name][-1]
        assert last["note"].endswith(f"exponent {last['values']['exponent']:.2f}")
    assert capsys.readouterr().out.count("exponent") == len(SYSTEMS)


def test_growth_of_a_system_in_a_file(tmp_path):
    name = write_toy(tmp_path)
    options = BenchOptions(what="growth", quick=True, size=("64x48",), system=(name,))
    options.check()
    rows = list(growth_rows(options))
    assert [row.method for row in rows] == [name] * 3
    assert rows[-1].values["n_gaussians"] > 0


def test_an_unknown_system_is_refused_before_anything_is_timed():
    with pytest.raises(KeyError, match="no system 'gsfuson'"):
        BenchOptions(what="growth", system=("gsfuson",)).check()


def test_ctrl_c_keeps_what_was_measured(monkeypatch, tmp_path, capsys):
    def rows(options):
        yield BenchRow(
            section="raster",
            case="a",
            method="m",
            timing=summary([Lap(1.0, 1.0)]),
        )
        raise KeyboardInterrupt

    monkeypatch.setitem(run.ROWS, "raster", rows)
    path = tmp_path / "b.json"
    assert run.main(BenchOptions(what="raster", json=str(path))) == 130
    assert "| a " in capsys.readouterr().out
    assert json.loads(path.read_text())["interrupted"]


def test_medians_by_hand():
    result = summary(
        [Lap(0.001, 0.010, 0.001), Lap(0.002, 0.030, 0.003), Lap(0.009, 0.020, 0.002)],
        peak_mb=5.0,
    )
    assert (result.wall_ms, result.cpu_ms, result.device_ms) == pytest.approx((2, 20, 2))
    assert (result.runs, result.peak_mb, summary([Lap(0.004, 0.001)]).device_ms) == (3, 5.0, None)


@pytest.mark.skipif(sys.platform != "linux", reason="peak memory is read from /proc")
def test_memory_of_a_known_size():
    with PeakMemory() as memory:
        torch.ones(25_000_000)
    if memory.peak_mb is None:
        pytest.skip("this system does not let a process reset its peak")
    assert 98 < memory.peak_mb < 120


@pytest.mark.parametrize(
    ("changes", "error", "name"),
    [
        ({"what": "rastre"}, KeyError, "rastre"),
        ({"backend": ("cuda", "numa")}, KeyError, "numa"),
        ({"threads": 0}, ValueError, "--threads"),
        ({"frames": 1}, ValueError, "--frames"),
        ({"size": ("640",)}, ValueError, "640"),
        ({"size": ("8x8",)}, ValueError, "8x8"),
        ({"data": "nowhere"}, FileNotFoundError, "nowhere"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_runs(changes, error, name):
    with pytest.raises(error, match=name):
        BenchOptions(**changes).check()
    assert BenchOptions(size=("64x48", "640X480")).sizes == [(64, 48), (640, 480)]


def test_the_scene_is_that_of_its_seed_and_fills_the_frustum_and_a_border():
    a, b, other = (random_scene(50, 64, 48, sh_degree=1, seed=s) for s in (3, 3, 4))
    assert all(
        torch.equal(x, y)
        for x, y in zip(
            vars(a.params).values(),
            vars(b.params).values(),
            strict=True,
        )
    )
    assert torch.equal(a.v_rgb, b.v_rgb)
    assert not torch.equal(a.params.xyz_W, other.params.xyz_W)
    scene = random_scene(5000, 320, 240)
    xyz_C = se3.apply(se3.inverse(scene.T_WC), scene.params.xyz_W)
    z = xyz_C[:, 2]
    uv = project(scene.camera, xyz_C) / torch.tensor([320.0, 240.0])
    assert torch.stack(z.aminmax()).tolist() == pytest.approx([2, 6], abs=0.05)
    assert torch.stack(uv.aminmax()).tolist() == pytest.approx([-0.05, 1.05], abs=0.005)
    assert scene.params.opacity_logit.sigmoid().aminmax() == pytest.approx((0.1, 0.95), abs=0.01)
    empty = random_scene(0, 64, 48)
    assert float(render(empty.params, empty.camera, empty.T_WC).alpha.max()) == 0


@pytest.mark.parametrize(
    ("n", "size"),
    [(1000, (160, 120)), (5000, (160, 120)), (5000, (320, 240))],
)
def test_about_thirty_gaussians_are_visible_at_a_pixel(n, size):
    """Counted by brute force at a few hundred pixels, from the projection alone."""
    scene = random_scene(n, *size)
    p = project_gaussians(scene.params, scene.camera, scene.T_WC)
    g = torch.Generator().manual_seed(1)
    uv = torch.rand(300, 1, 2, generator=g) * torch.tensor(size, dtype=torch.float32)
    dx, dy = (uv - p.uv).unbind(-1)
    A, B, C = p.conic.unbind(-1)
    alpha = p.opacity * torch.exp(-0.5 * (A * dx**2 + C * dy**2) - B * dx * dy)
    assert float((alpha >= ALPHA_MIN).sum(1).float().mean()) == pytest.approx(30, rel=0.25)


def test_the_truncation_is_what_the_table_says(small, monkeypatch):
    made = []
    volume_type = volume.TsdfVolume
    monkeypatch.setattr(
        volume, "TsdfVolume", lambda config, **o: made.append(config) or volume_type(config, **o)
    )
    options = BenchOptions(what="tsdf", quick=True, size=("64x48",), frames=2)
    assert list(volume.tsdf_rows(options))
    words = f"truncation {made[0].truncation_voxels:g} voxels"
    assert words in SECTIONS["tsdf"]
    assert {config.truncation_voxels for config in made} == {4.0}
