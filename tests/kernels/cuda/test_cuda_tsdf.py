"""Allocation, integration and meshing."""

import dataclasses
import importlib

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import TsdfVolume, band_blocks, extract_mesh
from gsfusion_nb.tsdf.integrate import fuse_frame_
from gsfusion_nb.types import Mesh

CONFIG = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0, max_weight=3.0)


def assert_same_blocks(config, frame, device, share=2e-3):
    """The same set in the same order, but for blocks that a ray only touches to rounding."""
    with use_backend("cuda"):
        ours = band_blocks(TsdfVolume(config, device=device), frame.to(device)).cpu()
    theirs = band_blocks.reference(TsdfVolume(config), frame)
    assert ours.dtype == theirs.dtype
    a, b = ({tuple(row) for row in x.tolist()} for x in (ours, theirs))
    assert len(a) == len(ours)
    assert len(a ^ b) <= share * max(len(b), 1), f"{len(a - b)} more and {len(b - a)} fewer of {len(b)} blocks"
    assert ours.tolist() == sorted(ours.tolist())
    return len(a), len(a ^ b)


@pytest.mark.parametrize("sdf", ["z", "ray"])
@pytest.mark.parametrize("guard", [True, False])
@pytest.mark.parametrize(("width", "height"), [(64, 48), (37, 29), (16, 1), (1, 1)])
def test_same_blocks(width, height, sdf, guard, make_frames, device):
    config = dataclasses.replace(CONFIG, sdf=sdf, outlier_guard=guard)
    for frame in make_frames(width, height):
        assert_same_blocks(config, frame, device)


@pytest.mark.parametrize("truncation_voxels", [1.0, 20.0])
@pytest.mark.parametrize("shift", [0.0, -640.0])
def test_bands_of_any_length_anywhere(truncation_voxels, shift, make_frames, device):
    config = dataclasses.replace(CONFIG, truncation_voxels=truncation_voxels, outlier_guard=False)
    for frame in make_frames(63, 47, shift=shift):
        assert assert_same_blocks(config, frame, device)[0] > 0


def test_a_set_that_is_too_small_grows(make_frames, device, monkeypatch):
    module = importlib.import_module("gsfusion_nb.kernels.cuda.allocate")
    frame = make_frames(40, 30, n=1)[0]
    with use_backend("cuda"):
        expected = band_blocks(TsdfVolume(CONFIG, device=device), frame.to(device))
        for slots, most in ((16, module._MOST_SLOTS), (16, 16)):
            monkeypatch.setattr(module, "_FIRST_SLOTS", slots)
            monkeypatch.setattr(module, "_MOST_SLOTS", most)
            found = band_blocks(TsdfVolume(CONFIG, device=device), frame.to(device))
            assert len(found) > 100
            assert abs(len(found) - len(expected)) <= 1


def test_missing_and_infinite_depth(make_frames, device):
    frame = make_frames(40, 30, n=1)[0]
    for depth in (torch.zeros(30, 40), torch.full((30, 40), float("inf")), torch.full((30, 40), 0.1)):
        assert assert_same_blocks(CONFIG, dataclasses.replace(frame, depth_m=depth), device) == (0, 0)
    mixed = frame.depth_m.clone()
    mixed[::3, ::4] = float("inf")
    for guard in (True, False):
        config = dataclasses.replace(CONFIG, near_m=0.0, outlier_guard=guard)
        assert_same_blocks(config, dataclasses.replace(frame, depth_m=mixed), device)


def test_a_bad_pose_is_refused(make_frames, device):
    frame = make_frames(40, 30, n=1)[0]
    bad = dataclasses.replace(frame, T_WC=frame.T_WC * float("nan")).to(device)
    with use_backend("cuda"), pytest.raises(ValueError, match="T_WC must be finite"):
        band_blocks(TsdfVolume(CONFIG, device=device), bad)


def both(config, frames, device):
    """The reference's volume and ours after the frames, on the blocks of the reference; observed voxels of each."""
    volumes, updated = [TsdfVolume(config), TsdfVolume(config, device=device)], [[], []]
    for frame in frames:
        blocks = band_blocks.reference(volumes[0], frame)
        for volume, counts in zip(volumes, updated, strict=True):
            volume.add_blocks(blocks.to(volume.device))
            ours = volume is volumes[1]
            with use_backend("cuda" if ours else "reference"):
                counts.append(fuse_frame_(volume, frame.to(volume.device))[1])
    return volumes, updated


def assert_same(volumes, compare, flips=1e-4):
    """Equal to rounding but for voxels that project within rounding of a pixel's border or of the band's end."""
    a, b = volumes
    assert torch.equal(a.block_coords, b.block_coords.cpu())
    compare("fuse_frame_", "W", b.W, a.W, 0.0, share=flips)
    compare("fuse_frame_", "D", b.D, a.D, 2e-6, share=flips)
    compare("fuse_frame_", "rgb", b.rgb_planes, a.rgb_planes, 2e-6, share=flips)


@pytest.mark.parametrize("sdf", ["z", "ray"])
@pytest.mark.parametrize(("width", "height"), [(64, 47), (16, 1)])
def test_same_voxels(width, height, sdf, make_frames, device, compare):
    frames = make_frames(width, height, n=4, eight_bit=False)
    volumes, (theirs, ours) = both(dataclasses.replace(CONFIG, sdf=sdf, near_m=0.0), frames, device)
    assert_same(volumes, compare)
    assert all(abs(a - b) <= 1e-4 * a for a, b in zip(theirs, ours, strict=True))
    assert width < 64 or float(volumes[1].W.max()) == 3.0


@pytest.mark.parametrize("shift", [-3.0, 640.0])
def test_voxels_anywhere_in_the_world(shift, make_frames, device, compare):
    volumes, _ = both(CONFIG, make_frames(40, 31, n=2, shift=shift), device)
    assert volumes[1].n_blocks > 100
    assert_same(volumes, compare, flips=1e-3)


def test_a_camera_inside_the_map(make_frames, device, compare):
    """Blocks around and behind the camera: nothing behind it is updated, and nothing is divided by zero."""
    frame = make_frames(64, 47, n=1)[0]
    frame = dataclasses.replace(frame, T_WC=torch.eye(4), depth_m=torch.full((47, 64), 1.0))
    axis = torch.arange(-3, 4)
    volumes = [TsdfVolume(CONFIG), TsdfVolume(CONFIG, device=device)]
    for volume in volumes:
        grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(-1, 3)
        volume.add_blocks(grid.to(volume.device))
    fuse_frame_.reference(volumes[0], frame)
    with use_backend("cuda"):
        touched, updated = fuse_frame_(volumes[1], frame.to(device))
    assert_same(volumes, compare)
    assert 0 < touched < len(axis) ** 3
    assert updated == int((volumes[0].W > 0).sum())


def test_frames_and_volumes_with_nothing_in_them(make_frames, device, compare):
    frame = make_frames(33, 21, n=1)[0]
    with use_backend("cuda"):
        assert fuse_frame_(TsdfVolume(CONFIG, device=device), frame.to(device)) == (0, 0)
    volumes, updated = both(CONFIG, [frame, dataclasses.replace(frame, depth_m=torch.zeros(21, 33))], device)
    assert_same(volumes, compare)
    assert updated[1][1] == 0


def test_strided_images(make_frames, device, compare):
    frame = make_frames(40, 31, n=1, eight_bit=False)[0]
    volumes = []
    for rgb in (frame.rgb, frame.rgb.permute(2, 0, 1).contiguous().permute(1, 2, 0)):
        volumes.append(both(CONFIG, [dataclasses.replace(frame, rgb=rgb)], device)[0][1])
    assert torch.equal(*(v.rgb_planes for v in volumes))


def assert_same_mesh(volume, device, compare, min_weight=1.0) -> Mesh:
    there = TsdfVolume(volume.config, device=device)
    there.load_state_dict(volume.state_dict())
    with use_backend("cuda"):
        ours = extract_mesh(there, min_weight=min_weight)
    theirs = extract_mesh.reference(volume, min_weight=min_weight)
    assert torch.equal(ours.faces.cpu(), theirs.faces)
    compare("extract_mesh", "vertices_W", ours.vertices_W, theirs.vertices_W, 1e-6)
    compare("extract_mesh", "rgb", ours.rgb, theirs.rgb, 1e-6)
    return ours


@pytest.mark.parametrize("missing", [0.0, 0.02, 0.5])
def test_random_signs_make_every_case(missing, generator, device, compare):
    """Noise has all 256 cases, across every kind of block border; blocks are missing and so are voxels."""
    axis = torch.arange(-1, 2)
    coords = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(-1, 3)
    volume = TsdfVolume(CONFIG)
    volume.add_blocks(coords[torch.rand(27, generator=generator) > 0.3][:, [2, 0, 1]])
    volume.D[:] = torch.rand(volume.D.shape, generator=generator) * 2 - 1
    volume.W[:] = (torch.rand(volume.W.shape, generator=generator) >= missing).float()
    volume.rgb_planes[:] = torch.rand(volume.rgb_planes.shape, generator=generator)
    mesh = assert_same_mesh(volume, device, compare)
    assert len(mesh.faces) > (1000 if missing < 0.1 else 10)


def test_mesh_of_a_fused_map(make_frames, device, compare):
    volume = both(CONFIG, make_frames(64, 47, n=2), device)[0][0]
    assert len(assert_same_mesh(volume, device, compare).faces) > 100
    assert len(assert_same_mesh(volume, device, compare, min_weight=2.0).faces) > 10
    assert len(assert_same_mesh(volume, device, compare, min_weight=1e6).faces) == 0


def test_empty_volume_single_block_and_no_surface(device, compare):
    assert assert_same_mesh(TsdfVolume(CONFIG), device, compare).faces.shape == (0, 3)
    volume = TsdfVolume(CONFIG)
    volume.add_blocks(torch.tensor([[-7, 3, 0]]))
    assert len(assert_same_mesh(volume, device, compare).faces) == 0
    volume.W[:] = 1.0
    assert len(assert_same_mesh(volume, device, compare).faces) == 0
    volume.D[0, 73] = -0.5  # voxel (1, 1, 1): a closed octahedron
    assert assert_same_mesh(volume, device, compare).faces.shape == (8, 3)
