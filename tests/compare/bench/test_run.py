"""The bench end to end on a handful of values."""

import json
import sys

import pytest

from gsfusion_nb.compare.bench import BenchOptions, latency, mapping, panels, raster, run, run_bench, scaling, tsdf
from gsfusion_nb.compare.bench.frames import stored_frames
from gsfusion_nb.compare.bench.options import SECTIONS
from gsfusion_nb.compare.bench.other_programs import OTHER_PROGRAMS, why_not
from gsfusion_nb.compare.bench.rows import Case, Row


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(raster, "COUNTS", (200, 300))
    monkeypatch.setattr(raster, "SIZES", ((64, 48),))
    monkeypatch.setattr(tsdf, "VOXEL_SIZES_M", (0.08, 0.04))
    monkeypatch.setattr(scaling, "GAUSSIANS", (100, 200, 400))
    monkeypatch.setattr(scaling, "GAUSSIANS_SIZE", (64, 48))
    monkeypatch.setattr(scaling, "PIXELS", ((32, 32), (64, 48), (96, 64)))
    monkeypatch.setattr(scaling, "PIXELS_GAUSSIANS", 200)
    monkeypatch.setattr(scaling, "VOXELS_M", (0.08, 0.06, 0.04))
    monkeypatch.setattr(panels, "PANELS", {"colour ball": panels.PANELS["colour ball"]})
    monkeypatch.setattr(latency, "VIEWS", 2)
    monkeypatch.setattr(BenchOptions, "budget_s", 0.0)
    import_lap = latency._import_lap
    monkeypatch.setattr(latency, "_import_lap", lambda module: import_lap("json"))
    for name in ("raster", "tsdf", "scaling", "mapping"):  # other programs are tested separately
        module = sys.modules[f"gsfusion_nb.compare.bench.{name}"]
        if hasattr(module, "why_not"):
            monkeypatch.setattr(module, "why_not", lambda name: "not installed: pip install it")


def test_raster(small):
    result = run_bench(BenchOptions(what="raster", quick=True))
    assert not result.interrupted
    assert result.n_done == result.n_cases == len(result.rows)
    methods = {row.method for row in result.rows}
    assert {"torch", "numba"} <= methods
    for row in result.rows:
        assert row.timing is not None
        assert row.timing.wall_ms > 0
        assert (row.speed == 1.0) == (row.method == "torch")
        if row.method != "torch":
            assert row.values["psnr_to_torch_db"] > 80
        if row.method != "torch" and "bwd" in row.case:
            assert row.values["least_gradient_cosine"] > 0.9999


@pytest.mark.ci
def test_all_groups_and_scaling(small, tmp_path, capsys):
    path = tmp_path / "bench.json"
    options = BenchOptions(quick=True, frames=2, size=("64x48",), scaling=True, json=str(path))
    assert run.main(options) == 0
    text = capsys.readouterr().out
    assert max(len(line) for line in text.splitlines() if str(tmp_path) not in line) <= 100
    numbers = json.loads(path.read_text())
    assert not numbers["interrupted"]
    assert numbers["machine"]["threads"] == 1
    assert {row["section"] for row in numbers["rows"]} == {*SECTIONS, "scaling"}
    tsdf = [row for row in numbers["rows"] if row["section"] == "tsdf"]
    assert any(row["case"].endswith(" / raycast") and row["timing"]["cpu_ms"] >= 0 for row in tsdf)
    fused = [row["values"] for row in tsdf if not row["case"].endswith(" / raycast")]
    assert all(values["blocks"] == fused[0]["blocks"] > 0 for values in fused)
    stages = [row["case"].partition(" / ")[2] for row in numbers["rows"] if row["section"] == "map"]
    assert stages[: 1 + len(mapping.STAGES)] == ["", *mapping.STAGES.values()]
    imports = [row["method"] for row in numbers["rows"] if "import" in row["case"]]
    assert imports == ["torch", "gsfusion_nb"]
    axes = {row["case"] for row in numbers["rows"] if row["section"] == "scaling"}
    assert len(axes) == 3
    assert all(-3 < row["values"]["exponent"] < 4 for row in numbers["rows"] if row["section"] == "scaling")


def test_ctrl_c_keeps_what_was_measured(monkeypatch, tmp_path, capsys):
    def cases(options):
        yield Case(section="raster", title="a", run=lambda: [Row(section="raster", case="a", method="m", note="done")])
        yield Case(section="raster", title="b", run=_interrupt)

    def _interrupt():
        raise KeyboardInterrupt

    monkeypatch.setitem(run.CASES, "raster", cases)
    path = tmp_path / "b.json"
    assert run.main(BenchOptions(what="raster", markdown=True, json=str(path))) == 130
    text = capsys.readouterr().out
    assert "| a | m |" in text
    assert "Interrupted after 1 of 2 cases." in text
    assert json.loads(path.read_text())["interrupted"]


def test_what_is_not_installed_is_named_with_its_remedy(monkeypatch):
    monkeypatch.setattr(run, "why_not", lambda name: f"not installed: {OTHER_PROGRAMS[name].remedy}")
    missing = run.not_measured(BenchOptions())
    assert missing["raster"]["gsplat (torch path)"] == "not installed: pip install gsplat==1.5.3"
    assert missing["tsdf"]["Open3D VoxelBlockGrid"] == "not installed: pip install open3d"
    assert "map" not in missing


def test_a_missing_module_is_told_from_a_broken_one(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert "pip install open3d" in (why_not("open3d") or "")


def test_a_missing_folder_is_said_before_anything_runs():
    with pytest.raises(FileNotFoundError, match="nowhere is not a folder"):
        run_bench(BenchOptions(what="tsdf", data="nowhere"))


@pytest.mark.skipif(why_not("opencv") is not None, reason="OpenCV has no volume before version 5")
def test_opencv_takes_our_frames():
    from gsfusion_nb.compare.bench.other_tsdf_volumes import FusionSettings, OpencvHash

    frames = stored_frames(BenchOptions(frames=2), (64, 48))
    settings = FusionSettings(voxel_size_m=0.08, truncation_voxels=4.0, far_m=5.0, threads=1)
    fuser = OpencvHash(settings, frames[0])
    assert len(tsdf.fuse_all(fuser, frames, 2)) == 2
    points, _ = fuser.volume.fetchPointsNormals()
    assert points.size > 0
