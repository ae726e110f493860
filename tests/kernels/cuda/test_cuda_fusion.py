"""Allocation and integration; the hash set and meshing are in ``test_cuda_tsdf.py``."""

import dataclasses

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import TsdfVolume, band_blocks
from gsfusion_nb.tsdf.integrate import fuse_frame_

CONFIG = TsdfConfig(
    voxel_size_m=0.02,
    truncation_voxels=4.0,
    max_weight=3.0,
    colour_band_voxels=0.0,
    colour_by_distance=False,
)


@pytest.fixture
def assert_same_blocks(device):
    """The same set in the same order, but for blocks that a ray only touches to rounding: none on
    the processor."""

    def check(config, frame, share):
        with use_backend("cuda"):
            ours = band_blocks(TsdfVolume(config, device), frame.to(device)).cpu()
        theirs = band_blocks.reference(TsdfVolume(config), frame)
        assert ours.dtype == theirs.dtype == torch.int64
        a, b = ({tuple(row) for row in x.tolist()} for x in (ours, theirs))
        assert len(a) == len(ours)
        most = share * max(len(b), 1) if device.type == "cuda" else 0
        assert len(a ^ b) <= most, f"{len(a - b)} more and {len(b - a)} fewer of {len(b)} blocks"
        assert ours.tolist() == sorted(ours.tolist())
        return len(a)

    return check


@pytest.mark.parametrize("truncation_voxels", [1.0, 20.0])
@pytest.mark.parametrize("shift", [0.0, -640.0])
def test_bands_of_any_length_anywhere(truncation_voxels, shift, make_frames, assert_same_blocks):
    config = dataclasses.replace(CONFIG, truncation_voxels=truncation_voxels, outlier_guard=False)
    for frame in make_frames(63, 47, shift=shift):
        assert assert_same_blocks(config, frame, share=2e-3) > 0


@pytest.fixture
def fuse_both(device):
    """``fuse_both(config, frames)``: the reference's volume and ours after the frames, on the
    blocks of the reference; observed voxels of each."""

    def fuse(config, frames):
        volumes = [TsdfVolume(config), TsdfVolume(config, device)]
        updated = [[], []]
        for frame in frames:
            blocks = band_blocks.reference(volumes[0], frame)
            for volume, counts, name in zip(volumes, updated, ("reference", "cuda"), strict=True):
                volume.add_blocks(blocks.to(volume.device))
                with use_backend(name):
                    counts.append(fuse_frame_(volume, frame.to(volume.device)))
        return volumes, updated

    return fuse


D_ROUNDING = 4e-6
"""Up to 4 m away the distance of a voxel is the sum of two float32 numbers: 2.6e-7 m, of a
truncation of 0.08 m."""


@pytest.fixture
def assert_same_voxels(compare):
    """Equal to rounding but for voxels that project within rounding of a pixel's border or of the
    band's end."""

    def check(volumes, flips=1e-4):
        a, b = volumes
        assert torch.equal(a.block_coords, b.block_coords.cpu())
        compare("fuse_frame_", "W", b.W, a.W, 0.0, share=flips)
        compare("fuse_frame_", "D", b.D, a.D, D_ROUNDING, share=flips)
        compare("fuse_frame_", "rgb", b.rgb_planes, a.rgb_planes, 2e-6, share=flips)

    return check


@pytest.mark.parametrize("sdf", ["z", "ray"])
@pytest.mark.parametrize(("width", "height"), [(64, 47), (16, 1)])
def test_same_voxels(width, height, sdf, make_frames, fuse_both, assert_same_voxels):
    frames = make_frames(width, height, n=4, eight_bit=False)
    volumes, updated = fuse_both(dataclasses.replace(CONFIG, sdf=sdf, near_m=0.0), frames)
    assert_same_voxels(volumes)
    for theirs, ours in zip(*updated, strict=True):
        assert abs(theirs - ours) <= 1e-4 * theirs
    assert width < 64 or float(volumes[1].W.max()) == 3.0


@pytest.mark.parametrize("weights", ["falling", "equal"])
def test_weights_of_colours(weights, make_frames, fuse_both, compare):
    """A distance that is off by its rounding moves a falling weight as much, and an equal one over
    the band's end."""
    colours = {"colour_band_voxels": 1.0, "colour_weights": weights, "max_weight": 100.0}
    (a, b), _ = fuse_both(dataclasses.replace(CONFIG, **colours), make_frames(64, 47, n=4))
    compare("fuse_frame_", "W_rgb", b.W_rgb, a.W_rgb, 1e-4, share=1e-4)
    fall_short = (a.W_rgb > 0.5) & ((a.W_rgb - a.W_rgb.round()).abs() > 0.01)
    assert bool(fall_short.any()) == (weights == "falling")


@pytest.mark.parametrize("shift", [-3.0, 640.0])
def test_voxels_anywhere_in_the_world(shift, make_frames, fuse_both, assert_same_voxels):
    volumes, _ = fuse_both(CONFIG, make_frames(40, 31, n=2, shift=shift))
    assert volumes[1].n_blocks > 100
    assert_same_voxels(volumes, flips=1e-3)


def test_a_camera_inside_the_map(make_frames, device, copy_to, assert_same_voxels):
    """Blocks around and behind the camera: nothing behind it is updated, and nothing is divided by
    zero."""
    frame = make_frames(64, 47, n=1)[0]
    frame = dataclasses.replace(
        frame,
        T_WC=torch.eye(4),
        depth_m=torch.full((47, 64), 1.0),
    )
    axis = torch.arange(-3, 4)
    volume = TsdfVolume(CONFIG)
    volume.add_blocks(
        torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(-1, 3)
    )
    ours = copy_to(volume)
    fuse_frame_.reference(volume, frame)
    with use_backend("cuda"):
        updated = fuse_frame_(ours, frame.to(device))
    assert_same_voxels((volume, ours))
    assert updated == int((ours.W > 0).sum())
    assert not bool((ours.W * (ours.block_coords[:, 2] < 0)[:, None]).any())
