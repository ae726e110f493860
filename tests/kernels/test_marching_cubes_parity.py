"""The CPU marching cubes against the reference: the same triangles, in the same order."""

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import TsdfVolume, extract_mesh, integrate

pytest.importorskip("numba")

CONFIG = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0)


def assert_same_mesh(volume, min_weight=1.0):
    with use_backend("numba"):
        ours = extract_mesh(volume, min_weight=min_weight)
    theirs = extract_mesh.reference(volume, min_weight=min_weight)
    assert torch.equal(ours.faces, theirs.faces)
    torch.testing.assert_close(ours.vertices_W, theirs.vertices_W, rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(ours.rgb, theirs.rgb, rtol=1e-6, atol=1e-6)
    return ours


@pytest.mark.parametrize("shift", [0.0, -5.0])
def test_a_fused_map(shift, make_frames):
    volume = TsdfVolume(CONFIG)
    for frame in make_frames(96, 71, n=4, shift=shift):
        integrate(volume, frame)
    assert len(assert_same_mesh(volume).faces) > 1000
    assert len(assert_same_mesh(volume, min_weight=2.0).faces) > 100
    assert len(assert_same_mesh(volume, min_weight=1e6).faces) == 0


@pytest.mark.parametrize("missing", [0.0, 0.02, 0.5])
def test_random_signs_make_every_case(missing, generator):
    """Noise has all 256 cases, across every kind of block border; blocks are missing and so are voxels."""
    axis = torch.arange(-2, 2)
    coords = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).view(-1, 3)
    volume = TsdfVolume(CONFIG)
    volume.add_blocks(coords[torch.rand(64, generator=generator) > 0.3][:, [2, 0, 1]])
    volume.D[:] = torch.rand(volume.D.shape, generator=generator) * 2 - 1
    volume.W[:] = (torch.rand(volume.W.shape, generator=generator) >= missing).float()
    volume.rgb_planes[:] = torch.rand(volume.rgb_planes.shape, generator=generator)
    mesh = assert_same_mesh(volume)
    assert len(mesh.faces) > (1000 if missing < 0.1 else 10)


def test_empty_volume_single_block_and_no_surface():
    assert assert_same_mesh(TsdfVolume(CONFIG)).faces.shape == (0, 3)
    volume = TsdfVolume(CONFIG)
    volume.add_blocks(torch.tensor([[-7, 3, 0]]))
    assert len(assert_same_mesh(volume).faces) == 0
    volume.W[:] = 1.0
    assert len(assert_same_mesh(volume).faces) == 0
    volume.D[0, 73] = -0.5  # voxel (1, 1, 1): a closed octahedron
    assert assert_same_mesh(volume).faces.shape == (8, 3)
