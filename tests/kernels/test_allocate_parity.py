"""The blocks that the CPU kernel finds are the reference's, to the last one and in the same
order."""

import dataclasses

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import TsdfVolume, band_blocks

pytest.importorskip("numba")

from gsfusion_nb.kernels.allocate import numba as kernel  # pyright: ignore[reportMissingImports]

CONFIG = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0)


def assert_same_blocks(config, frame):
    volume = TsdfVolume(config)
    with use_backend("numba"):
        ours = band_blocks(volume, frame)
    theirs = band_blocks.reference(volume, frame)
    assert ours.dtype == theirs.dtype
    assert torch.equal(ours, theirs)
    return ours


@pytest.mark.parametrize("sdf", ["z", "ray"])
@pytest.mark.parametrize("guard", [True, False])
@pytest.mark.parametrize(
    ("width", "height"),
    [(160, 120), (37, 29), (16, 1), (1, 1), (15, 33)],
)
def test_same_blocks(width, height, sdf, guard, make_frames):
    config = dataclasses.replace(CONFIG, sdf=sdf, outlier_guard=guard)
    for frame in make_frames(width, height):
        assert_same_blocks(config, frame)


@pytest.mark.parametrize("truncation_voxels", [1.0, 3.0, 20.0])
@pytest.mark.parametrize("shift", [0.0, -640.0])
def test_bands_of_any_length_anywhere(truncation_voxels, shift, make_frames):
    config = dataclasses.replace(CONFIG, truncation_voxels=truncation_voxels, outlier_guard=False)
    for frame in make_frames(63, 47, shift=shift):
        assert len(assert_same_blocks(config, frame)) > 0


def test_missing_and_infinite_depth(make_frames):
    frame = make_frames(40, 30, n=1)[0]
    for depth in (
        torch.zeros(30, 40),
        torch.full((30, 40), float("inf")),
        torch.full((30, 40), 0.1),
    ):
        assert len(assert_same_blocks(CONFIG, dataclasses.replace(frame, depth_m=depth))) == 0
    mixed = frame.depth_m.clone()
    mixed[::3, ::4] = float("inf")
    assert_same_blocks(
        dataclasses.replace(CONFIG, near_m=0.0), dataclasses.replace(frame, depth_m=mixed)
    )
    assert_same_blocks(
        dataclasses.replace(CONFIG, near_m=0.0, outlier_guard=False),
        dataclasses.replace(frame, depth_m=mixed),
    )


def test_what_the_kernel_does_not_take_goes_to_the_reference(make_frames, monkeypatch):
    frame = make_frames(40, 30, n=1)[0]
    strided = torch.stack([frame.depth_m] * 2, dim=-1)[..., 0]
    expected = assert_same_blocks(CONFIG, frame)
    assert torch.equal(
        assert_same_blocks(CONFIG, dataclasses.replace(frame, depth_m=strided)), expected
    )
    monkeypatch.setattr(kernel, "_MAP_CELLS", 10)
    assert torch.equal(assert_same_blocks(CONFIG, frame), expected)


def test_a_bad_pose_is_refused(make_frames):
    frame = make_frames(40, 30, n=1)[0]
    with use_backend("numba"), pytest.raises(ValueError, match="T_WC must be finite"):
        band_blocks(
            TsdfVolume(CONFIG),
            dataclasses.replace(frame, T_WC=frame.T_WC * float("nan")),
        )


def test_any_number_of_threads_gives_the_same(make_frames):
    frame = make_frames(160, 120, n=1)[0]
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        results.append(assert_same_blocks(CONFIG, frame))
    torch.set_num_threads(1)
    assert torch.equal(*results)
