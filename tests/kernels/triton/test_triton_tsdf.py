"""Allocation, integration, raycast and look-ups of the volumetric map."""

# pyright: reportFunctionMemberAccess=false

import dataclasses

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import TsdfVolume, band_blocks, integrate, raycast
from gsfusion_nb.tsdf.integrate import fuse_frame_
from gsfusion_nb.tsdf.volume import sample_voxels

CONFIG = TsdfConfig(voxel_size_m=0.08, truncation_voxels=3.0, max_weight=3.0)
FINE = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0)


@pytest.fixture
def copy_to(device):
    """``copy_to(volume)``: the same map on the device of the kernels."""

    def move(volume: TsdfVolume) -> TsdfVolume:
        copy = TsdfVolume(volume.config, device)
        copy.load_state_dict(volume.state_dict())
        return copy

    return move


@pytest.fixture
def mapped(make_frames):
    frames = make_frames(40, 30, n=2)
    volume = TsdfVolume(CONFIG)
    with use_backend("reference"):
        for frame in frames:
            integrate(volume, frame)
    return volume, frames


@pytest.mark.parametrize("sdf", ["z", "ray"])
@pytest.mark.parametrize("guard", [True, False])
@pytest.mark.parametrize(("width", "height"), [(37, 29), (16, 1), (1, 1)])
def test_same_blocks(width, height, sdf, guard, make_frames, device):
    """The same set to the last block under the interpreter; on a GPU multiplications and additions are contracted."""
    config = dataclasses.replace(FINE, sdf=sdf, outlier_guard=guard)
    for frame in make_frames(width, height, n=2):
        expected = band_blocks.reference(TsdfVolume(config), frame)
        with use_backend("triton"):
            found = band_blocks(TsdfVolume(config, device), frame.to(device)).cpu()
        assert found.dtype == torch.int64
        if device.type == "cpu":
            assert torch.equal(found, expected)
        else:
            a, b = ({tuple(row) for row in blocks.tolist()} for blocks in (found, expected))
            assert len(a ^ b) <= 1e-3 * len(b)


@pytest.mark.parametrize(("truncation_voxels", "shift"), [(1.0, 0.0), (12.0, -640.0)])
def test_bands_of_any_length_anywhere(truncation_voxels, shift, make_frames, device):
    config = dataclasses.replace(FINE, truncation_voxels=truncation_voxels, outlier_guard=False)
    frame = make_frames(31, 23, n=1, shift=shift)[0]
    expected = band_blocks.reference(TsdfVolume(config), frame)
    with use_backend("triton"):
        found = band_blocks(TsdfVolume(config, device), frame.to(device)).cpu()
    assert abs(len(found) - len(expected)) <= 1e-3 * len(expected)


def test_missing_and_infinite_depth(make_frames, device):
    frame = make_frames(20, 15, n=1)[0]
    with use_backend("triton"):
        for depth in (torch.zeros(15, 20), torch.full((15, 20), float("inf")), torch.full((15, 20), 0.1)):
            empty = dataclasses.replace(frame, depth_m=depth).to(device)
            assert len(band_blocks(TsdfVolume(FINE, device), empty)) == 0
        with pytest.raises(ValueError, match="T_WC must be finite"):
            band_blocks(TsdfVolume(FINE, device), dataclasses.replace(frame, T_WC=frame.T_WC * float("nan")).to(device))


@pytest.mark.parametrize("sdf", ["z", "ray"])
def test_same_voxels(sdf, make_frames, device, compare, copy_to):
    config = dataclasses.replace(CONFIG, sdf=sdf, near_m=0.0)
    volume, frames = TsdfVolume(config), make_frames(29, 23, n=2)
    for frame in frames:
        volume.add_blocks(band_blocks.reference(volume, frame))
    ours = copy_to(volume)
    for frame in (*frames, *frames):
        _, expected = fuse_frame_.reference(volume, frame)
        with use_backend("triton"):
            touched, updated = fuse_frame_(ours, frame.to(device))
        assert abs(updated - expected) <= max(3, 5e-4 * expected)
        assert 0 < touched <= volume.n_blocks
    assert float(ours.W.max()) == 3.0
    for name in ("D", "W", "rgb_planes"):
        compare("fuse_frame_", name, getattr(ours, name), getattr(volume, name), 2e-6, share=1e-3)


def test_a_camera_inside_the_map_and_nothing_to_do(make_frames, device, compare, copy_to):
    frame = make_frames(32, 23, n=1)[0]
    frame = dataclasses.replace(frame, T_WC=torch.eye(4), depth_m=torch.full((23, 32), 1.0))
    axis = torch.arange(-1, 3)
    volume = TsdfVolume(CONFIG)
    with use_backend("triton"):
        assert fuse_frame_(TsdfVolume(CONFIG, device), frame.to(device)) == (0, 0)
    volume.add_blocks(torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(-1, 3))
    ours = copy_to(volume)
    fuse_frame_.reference(volume, frame)
    with use_backend("triton"):
        _, updated = fuse_frame_(ours, frame.to(device))
        before = ours.W.clone()
        assert fuse_frame_(ours, dataclasses.replace(frame, depth_m=torch.zeros(23, 32)).to(device))[1] == 0
    assert torch.equal(before, ours.W)
    assert updated == int((before > 0).sum())
    compare("fuse_frame_", "D", ours.D, volume.D, 2e-6, share=1e-3)
    assert not bool((ours.W * (ours.block_coords[:, 2] < 0)[:, None]).any())


def test_far_from_the_origin(make_frames, device, compare, copy_to):
    volume, frame = TsdfVolume(CONFIG), make_frames(32, 23, n=1, shift=640.0)[0]
    volume.add_blocks(band_blocks.reference(volume, frame))
    ours = copy_to(volume)
    fuse_frame_.reference(volume, frame)
    with use_backend("triton"):
        fuse_frame_(ours, frame.to(device))
    compare("fuse_frame_", "D", ours.D, volume.D, 2e-6, share=2e-3)


@pytest.mark.parametrize(("width", "height"), [(20, 15), (17, 1), (1, 1)])
def test_same_picture(width, height, mapped, to, compare, copy_to):
    volume, frames = mapped
    camera, ours = frames[0].camera.resized(width, height), copy_to(volume)
    for frame in frames[:1]:
        expected = raycast.reference(volume, camera, frame.T_WC)
        with use_backend("triton"):
            found = raycast(ours, camera, to(frame.T_WC))
        for name, tolerance in (("depth_m", 1e-5), ("normal_W", 1e-3), ("rgb", 1e-3)):
            compare("raycast", name, getattr(found, name), getattr(expected, name), tolerance, share=1e-2)
    assert height < 15 or float((found.depth_m > 0).double().mean()) > 0.2


def test_raycast_from_inside_and_of_nothing(mapped, device, compare, copy_to):
    volume, frames = mapped
    camera = frames[0].camera.resized(16, 12)
    volume.W[::3] = 0.0
    expected = raycast.reference(volume, camera, torch.eye(4))
    with use_backend("triton"):
        found = raycast(copy_to(volume), camera, torch.eye(4))
        empty = raycast(TsdfVolume(CONFIG, device), camera, torch.eye(4))
    compare("raycast", "depth_m", found.depth_m, expected.depth_m, 1e-5, share=1e-2)
    assert not bool(empty.depth_m.any())


def test_same_samples(mapped, to, compare, copy_to, generator):
    volume, _ = mapped
    points = torch.cat([3 * torch.rand(200, 3, generator=generator) - 1.5, torch.tensor([[1e30, 0.0, -1e30]])])
    expected = sample_voxels.reference(volume, points)
    with use_backend("triton"):
        found = sample_voxels(copy_to(volume), to(points))
        none = sample_voxels(copy_to(volume), to(points[:0]))
    assert len(none.D) == 0
    assert float((expected.W > 0).double().mean()) > 0.05
    for name in ("D", "W", "rgb"):
        compare("sample_voxels", name, getattr(found, name), getattr(expected, name), 0.0)
