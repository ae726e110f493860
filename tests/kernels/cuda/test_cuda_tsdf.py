"""The hash set of the allocation, single voxels, and meshing; the rest is in
``test_cuda_fusion.py``."""

import dataclasses
import importlib

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import FusedView, TsdfVolume, band_blocks, extract_mesh, fuse_frame_
from gsfusion_nb.types import Mesh

CONFIG = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0, max_weight=3.0)


def test_a_set_that_is_too_small_grows(make_frames, device, monkeypatch):
    module = importlib.import_module("gsfusion_nb.kernels.allocate.cuda")
    frame = make_frames(40, 30, n=1)[0]
    with use_backend("cuda"):
        expected = band_blocks(TsdfVolume(CONFIG, device=device), frame.to(device))
        for slots, most in ((16, module._MOST_SLOTS), (16, 16)):
            monkeypatch.setattr(module, "_FIRST_SLOTS", slots)
            monkeypatch.setattr(module, "_MOST_SLOTS", most)
            found = band_blocks(TsdfVolume(CONFIG, device=device), frame.to(device))
            assert len(found) > 100
            assert abs(len(found) - len(expected)) <= 1


@pytest.mark.parametrize("sdf", ["z", "ray"])
def test_the_preview_is_what_the_fusion_writes(sdf, make_frames, device, generator):
    """To the last bit: in old and in new blocks, in blocks that are not needed, and where no block
    can be."""
    config = dataclasses.replace(CONFIG, sdf=sdf)
    volume = TsdfVolume(config, device=device)
    changed = 0
    with use_backend("cuda"):
        for frame in make_frames(64, 47, n=4, eight_bit=False):
            frame = frame.to(device)
            missing = volume.reserve(volume.index.missing(band_blocks(volume, frame)))
            nearby = 1.4 * torch.rand(3000, 3, generator=generator).to(device) - 0.7
            voxels = volume.config.voxel_size_m * (8 * missing.coords.float() + 4.5)
            points = torch.cat([nearby, voxels, nearby[:1] * torch.inf, nearby[:1] * 1e8])
            before = volume.sample_nearest(points)
            preview = FusedView(volume, frame, missing).sample_nearest(points)
            volume.allocate_missing(missing)
            fuse_frame_(volume, frame)
            after = volume.sample_nearest(points)
            for name in ("D", "W", "rgb"):
                assert torch.equal(getattr(preview, name), getattr(after, name))
            changed += int((preview.W != before.W).sum())
    assert changed > 1000


def assert_same_mesh(volume, copy_to, compare, min_weight=1.0) -> Mesh:
    with use_backend("cuda"):
        ours = extract_mesh(copy_to(volume), min_weight=min_weight)
    theirs = extract_mesh.reference(volume, min_weight=min_weight)
    assert torch.equal(ours.faces.cpu(), theirs.faces)
    compare("extract_mesh", "vertices_W", ours.vertices_W, theirs.vertices_W, 1e-6)
    compare("extract_mesh", "rgb", ours.rgb, theirs.rgb, 1e-6)
    return ours


@pytest.mark.parametrize("missing", [0.0, 0.02, 0.5])
def test_random_signs_make_every_case(missing, generator, copy_to, compare):
    """Noise has all 256 cases, across every kind of block border; blocks are missing and so are
    voxels."""
    axis = torch.arange(-1, 2)
    coords = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(-1, 3)
    volume = TsdfVolume(CONFIG)
    volume.add_blocks(coords[torch.rand(27, generator=generator) > 0.3][:, [2, 0, 1]])
    volume.D[:] = torch.rand(volume.D.shape, generator=generator) * 2 - 1
    volume.W[:] = (torch.rand(volume.W.shape, generator=generator) >= missing).float()
    volume.rgb_planes[:] = torch.rand(volume.rgb_planes.shape, generator=generator)
    mesh = assert_same_mesh(volume, copy_to, compare)
    assert len(mesh.faces) > (1000 if missing < 0.1 else 10)


def test_empty_volume_single_block_and_no_surface(copy_to, compare):
    assert assert_same_mesh(TsdfVolume(CONFIG), copy_to, compare).faces.shape == (0, 3)
    volume = TsdfVolume(CONFIG)
    volume.add_blocks(torch.tensor([[-7, 3, 0]]))
    assert len(assert_same_mesh(volume, copy_to, compare).faces) == 0
    volume.W[:] = 1.0
    assert len(assert_same_mesh(volume, copy_to, compare).faces) == 0
    volume.D[0, 73] = -0.5  # voxel (1, 1, 1): a closed octahedron
    assert assert_same_mesh(volume, copy_to, compare).faces.shape == (8, 3)
