"""All systems, from the first frame to the report, on a device that is not the processor."""

import functools
import gc
import logging

import pytest
import torch

from gsfusion_nb import backends
from gsfusion_nb.config import DataConfig, OptimConfig, gps_slam, gsfusion, rtg_slam
from gsfusion_nb.data import open_sequence
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.mapping import GPSSLAM, RTGSLAM, GSFusion, make_mapper
from gsfusion_nb.mapping.surfel_optimiser import SurfelOptimiser
from gsfusion_nb.optim import adam_step
from gsfusion_nb.runs import MappingRun, outputs, run_mapping
from gsfusion_nb.runs.resume import load_run
from gsfusion_nb.types import GaussianParams, Seeds

DATA = {"width": 40, "height": 30, "stop": 9, "stride": 2, "hold_out_every": 4, "hold_out_offset": 2}
FRAMES_MOST = 40
"""Waits for the device in a frame, besides those of the optimisation."""
GSFUSION_MOST = {"waits": 12, "launches": 160}
"""In a frame of GSFusion, besides the optimisation. Three of the waits are copies to the GPU, which does not stop for
them; the others: is the image valid, the number of blocks, of new ones, of leaves, of leaves with depth and of seeds,
are the seeds valid (twice), and the number of observed voxels."""


def gsfusion_settings(**changes):
    return gsfusion(
        "room",
        data=DATA,
        tsdf__voxel_size_m=0.08,
        seeding__quadtree_threshold=2e-3,
        keyframe_min_seeds=5,
        optim__global_iterations=1,
        **changes,
    )


def rtg_slam_settings(**changes):
    return rtg_slam(
        "room",
        data=DATA,
        window={"iterations": 2, "every_frames": 2},
        keyframes__iterations=2,
        final__passes=1,
        mesh__voxel_size_m=0.08,
        **changes,
    )


def gps_slam_settings(**changes):
    """Long enough for the first seeds, before the eleventh mapped frame."""
    return gps_slam(
        "room",
        data=DATA | {"stop": 32},
        tsdf__voxel_size_m=0.08,
        schedule={"iterations": 4, "keyframes": 2},
        final__passes=1,
        **changes,
    )


ALL_SETTINGS = [gsfusion_settings, rtg_slam_settings, gps_slam_settings]


@pytest.mark.parametrize("settings", ALL_SETTINGS)
def test_a_run_gives_what_it_gives_on_the_processor(settings, gpu, tmp_path, monkeypatch):
    monkeypatch.setattr(outputs, "score_mesh", lambda *_: {})  # of the mesh on the processor, and slow
    there, here = (run_mapping("room", settings(), folder=tmp_path / d, device=d) for d in ("cuda", "cpu"))
    assert there.mapper.gaussians.params.xyz_W.device.type == "cuda"
    assert (tmp_path / "cuda" / "report.html").stat().st_size > 10_000
    assert len(there.run.steps) == len(here.run.steps) > 2
    assert there.metrics["n_gaussians"] == pytest.approx(here.metrics["n_gaussians"], rel=0.02)
    for name in ("psnr_mapped_db", "psnr_held_out_db"):
        assert there.metrics[name] == pytest.approx(here.metrics[name], abs=0.1)


@pytest.mark.parametrize(("system", "settings"), [(GSFusion, gsfusion_settings), (RTGSLAM, rtg_slam_settings)])
def test_tracking_finds_what_it_finds_on_the_processor(system, settings, gpu):
    there, here = (system(settings(tracking__poses="tracked"), device=d) for d in ("cuda", "cpu"))
    for frame in frames(3, width=80, height=60):  # of 40 x 30 pixels rounding alone moves a pose by centimetres
        reports = [mapper.step(frame) for mapper in (there, here)]
        assert reports[0].tracking["status"] == reports[1].tracking["status"]
    for a, b in zip(there.localiser.poses, here.localiser.poses, strict=True):
        torch.testing.assert_close(a, b, rtol=0.0, atol=5e-3)


def frames(n: int, *, width: int = 40, height: int = 30):
    sequence = open_sequence("room", data=DataConfig(width=width, height=height))
    return [sequence.mapping[i] for i in range(n)]


def test_torch_takes_over_from_cuda_kernels_that_do_not_compile(gpu, monkeypatch, caplog):
    """In the middle of a frame: PyTorch continues on the GPU with a warning, and Triton's kernels stay in use."""
    from gsfusion_nb.kernels.runtime.cuda import driver  # pyright: ignore[reportMissingImports]

    def start(operation, stem, *rest, start=driver.start):
        if stem == "composite":
            raise backends.KernelsUnusable("cuda", "composite.cu does not compile")
        start(operation, stem, *rest)

    monkeypatch.setattr(driver, "start", start)
    monkeypatch.setattr(backends, "_set_aside", set())
    monkeypatch.setattr(backends, "automatic", functools.cache(backends.automatic.__wrapped__))
    there, here = (GSFusion(gsfusion_settings(), device=d) for d in ("cuda", "cpu"))
    with caplog.at_level(logging.WARNING, logger="gsfusion_nb.backends"):
        for frame in frames(2):
            ours, theirs = (mapper.step(frame) for mapper in (there, here))
            assert ours.psnr_after_db == pytest.approx(theirs.psnr_after_db, abs=0.1)
    assert len(there.gaussians) == pytest.approx(len(here.gaussians), rel=0.02)
    assert caplog.messages[0] == "backend 'cuda' is not used any more: composite.cu does not compile"
    chosen = {
        "render_forward": "torch",
        "render_vjp": "torch",
        "quadtree": "torch",
        "band_blocks": "reference",
        "fuse_frame_": "reference",
        "disc_depth": "triton",
        "icp_system": "triton",
    }
    assert {name: backends.automatic(name, "cuda") for name in chosen} == chosen


def test_gsfusion_waits_for_the_number_of_pairs_only(gpu):
    """In an optimisation step the host waits for the device once: how many (Gaussian, tile) pairs to make room for; and
    after the steps of a frame once for their losses."""
    mapper = GSFusion(gsfusion_settings(), device="cuda")
    for frame in frames(2):
        gpu.clear()
        report = mapper.step(frame)
    optim = mapper.config.optim
    steps = optim.keyframe_iterations if report.is_keyframe else optim.frame_iterations + 1
    assert gpu.n_waits <= GSFUSION_MOST["waits"] + steps + 1, gpu.waits.most_common()
    mapper._optimise_view(mapper.keyframes[0], ssim_weight=0.2)  # the window of SSIM is made once
    gpu.clear()
    for i in range(3):
        mapper._optimise_view(mapper.keyframes[0], ssim_weight=0.2 * i)
    assert gpu.n_waits == 3, gpu.waits.most_common()
    assert {place.split(":")[0] for _, place in gpu.waits} == {"binning/cuda.py"}
    assert mapper.keyframes[0].rgb_u8.dtype == torch.uint8


def test_gsfusion_starts_little_besides_the_optimisation(gpu, monkeypatch):
    mapper = GSFusion(gsfusion_settings(), device="cuda")
    monkeypatch.setattr(mapper, "_optimise_online", lambda *_: [])
    for frame in frames(2):
        gpu.clear()
        mapper.step(frame)
    assert gpu.launches <= GSFUSION_MOST["launches"]
    assert gpu.n_waits <= GSFUSION_MOST["waits"], gpu.waits.most_common()


@pytest.mark.parametrize(("steps", "launches"), [("none", 1), ("shared", 1), ("per_row", 2)])
def test_an_adam_step_of_a_map_is_one_launch(steps, launches, gpu):
    """And one more for the age of every row."""
    model = GaussianModel(sh_degree=3, device="cuda")
    xyz_W, rgb, radius_m = (torch.rand(shape).to("cuda") for shape in ((5, 3), (5, 3), (5,)))
    model.append(Seeds.isotropic(xyz_W, rgb, radius_m))
    gradients = GaussianParams(**{name: torch.ones_like(column) for name, column in vars(model.params).items()})
    gpu.clear()
    adam_step(model, gradients, OptimConfig(adam_steps=steps))
    assert (gpu.launches, gpu.n_waits) == (launches, 0)


def test_rtg_slam_waits_for_the_number_of_pairs_only(gpu, monkeypatch):
    waits = []
    step = SurfelOptimiser.step

    def counted(self, view, outputs):
        before = gpu.n_waits
        loss = step(self, view, outputs)
        waits.append(gpu.n_waits - before)
        return loss

    monkeypatch.setattr(SurfelOptimiser, "step", counted)
    mapper = RTGSLAM(rtg_slam_settings(), device="cuda")
    for frame in frames(5):
        before, steps = gpu.n_waits, len(waits)
        mapper.step(frame)
        assert gpu.n_waits - before - sum(waits[steps:]) <= 4 * FRAMES_MOST, gpu.waits.most_common()
    assert len(waits) >= 4
    assert set(waits) == {1}, gpu.waits.most_common()


@pytest.mark.parametrize("settings", ALL_SETTINGS)
def test_a_run_is_resumed_on_the_device(settings, gpu, tmp_path):
    mapper = make_mapper(settings(), device="cuda")
    run = MappingRun(open_sequence("room", data=settings().data), mapper, source={"path_or_name": "room"})
    online = run.online()
    next(online)
    online.close()
    run.save_checkpoint(tmp_path)
    resumed = load_run(tmp_path, device="cuda")
    assert len(list(resumed.online())) >= 2
    assert resumed.mapper.gaussians.params.sh.device.type == "cuda"
    assert resumed.mapper.mesh().faces.device.type == "cuda"


def on_the_device() -> int:
    """Bytes of all tensors that can be reached."""
    gc.collect()
    return sum(t.inner.nbytes for t in gc.get_objects() if type(t).__name__ == "OnGpu")


@pytest.mark.parametrize(
    ("system", "settings"),
    [(GSFusion, gsfusion_settings), (RTGSLAM, rtg_slam_settings), (GPSSLAM, gps_slam_settings)],
)
def test_nothing_stays_on_the_device(system, settings, gpu):
    """When the mapper goes, so do its maps, frames and keyframes: what is left are constants of a few hundred bytes."""
    before = on_the_device()  # open widgets of other tests hold their maps
    mapper = system(settings(), device="cuda")
    for frame in frames(2):
        mapper.step(frame)
    for _ in mapper.global_optimise(1):
        pass
    del mapper, frame, _
    assert on_the_device() - before < 20_000
