"""The CPU ray caster against the reference: the same rays meet the surface, at the same depth."""

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.geometry import se3
from gsfusion_nb.tsdf import TsdfVolume, integrate, raycast

pytest.importorskip("numba")

CONFIG = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0)


@pytest.fixture
def mapped(make_frames):
    frames = make_frames(160, 120, n=4)
    volume = TsdfVolume(CONFIG)
    for frame in frames:
        integrate(volume, frame)
    return volume, frames


def numba_raycast(volume, camera, T_WC):
    with use_backend("numba"):
        return raycast(volume, camera, T_WC)


def assert_same_picture(volume, camera, T_WC, share=2e-3):
    """Marching branches on a sign: a step within rounding of it may go the other way, at a
    ``share`` of the pixels."""
    ours = numba_raycast(volume, camera, T_WC)
    theirs = raycast.reference(volume, camera, T_WC)
    for name, tolerance in (("depth_m", 1e-5), ("normal_W", 1e-3), ("rgb", 1e-3)):
        a = getattr(ours, name)
        b = getattr(theirs, name)
        assert a.shape == b.shape
        assert bool(torch.isfinite(a).all())
        off = ((a - b).abs() > tolerance).double()
        assert float(off.mean()) <= share, (
            f"{name}: {int(off.sum())} of {off.numel()} values differ"
        )
    return ours


@pytest.mark.parametrize(
    ("width", "height"),
    [(160, 120), (37, 29), (1, 1), (17, 3)],
)
def test_same_picture(width, height, mapped):
    volume, frames = mapped
    camera = frames[0].camera.resized(width, height)
    for frame in frames:
        out = assert_same_picture(volume, camera, frame.T_WC, share=5e-3)
    assert width < 100 or float((out.depth_m > 0).double().mean()) > 0.5


@pytest.mark.parametrize(("width", "copied"), [(200, True), (40, False)])
def test_many_rays_and_few_stop_at_observed_voxels_only(width, copied, mapped, monkeypatch):
    """Many look D up in a copy that has been marked before, few in the map itself."""
    from gsfusion_nb.kernels.raycast import numba

    volume, frames = mapped
    volume.W[:, ::7] = 0.0
    look_up = numba.look_up
    ways = []
    monkeypatch.setattr(
        numba,
        "look_up",
        lambda *args: ways.append(look_up(*args)) or ways[-1],
    )
    camera = frames[0].camera.resized(width, width * 3 // 4)
    assert_same_picture(volume, camera, frames[0].T_WC, share=1e-2)
    assert ways == [copied]


@pytest.mark.ci
def test_a_view_of_too_many_blocks_is_the_same_through_the_table_of_nodes(mapped, monkeypatch):
    from gsfusion_nb.kernels.raycast import numba

    volume, frames = mapped
    near = numba_raycast(volume, frames[0].camera, frames[0].T_WC)
    monkeypatch.setattr(numba, "NEAR_BLOCKS", 1)
    far = numba_raycast(volume, frames[0].camera, frames[0].T_WC)
    assert torch.equal(near.depth_m, far.depth_m)
    assert torch.equal(near.normal_W, far.normal_W)
    assert torch.equal(near.rgb, far.rgb)


@pytest.mark.parametrize("tile_px", [4, 8, 12, 64])
def test_no_size_of_tile_loses_a_surface(tile_px, mapped, monkeypatch):
    """From random places in and around the room, blocks beside and behind the camera included."""
    from gsfusion_nb.kernels.raycast import numba

    monkeypatch.setattr(numba, "TILE_PX", tile_px)
    volume, frames = mapped
    camera = frames[0].camera.resized(45, 34)
    generator = torch.Generator().manual_seed(tile_px)
    for frame in frames:
        moved = 0.4 * torch.randn(6, generator=generator)
        T_WC = frame.T_WC @ se3.exp(moved)
        ours = numba_raycast(volume, camera, T_WC)
        theirs = raycast.reference(volume, camera, T_WC)
        lost = (ours.depth_m == 0) & (theirs.depth_m > 0)
        gained = (ours.depth_m > 0) & (theirs.depth_m == 0)
        assert bool((theirs.depth_m > 0).any())
        assert int(lost.sum()) + int(gained.sum()) <= 3, (
            f"{int(lost.sum())} surfaces lost, {int(gained.sum())} gained"
        )


def test_walls_beside_the_camera_do_not_make_rays_start_at_it(mapped):
    """Blocks that no ray can meet do not count: all rays start at the nearest block of their tile,
    or never."""
    from gsfusion_nb.kernels.raycast.reach import NEAR_END, look_up
    from gsfusion_nb.kernels.runtime.arguments import lens_of
    from gsfusion_nb.kernels.runtime.numba.blocks import blocks_in_view

    _, frames = mapped
    beside = TsdfVolume(CONFIG)
    beside.add_blocks(torch.tensor([[10, 0, 0], [-10, 0, 0], [0, -8, 0], [0, 0, 20], [0, 0, -3]]))
    camera = frames[0].camera
    lens = lens_of(camera)
    size = (camera.height, camera.width)
    blocks = beside.block_coords.numpy(), beside.D.view(-1).numpy(), beside.W.view(-1).numpy()
    spans = torch.empty(15, 20, 2).numpy()
    T_CW = torch.eye(4, dtype=torch.float64).numpy()
    marked = torch.empty(5 * 512).numpy()
    rows = blocks_in_view(beside, camera, T_CW, float("inf"), 0.04)
    look_up(blocks, rows, T_CW, lens, beside.block_size_m, size, 8, marked, spans)
    z = beside.block_coords[rows, 2].tolist()
    assert 20 in z
    assert -3 not in z
    assert 20 not in beside.block_coords[blocks_in_view(beside, camera, T_CW, 2.0, 0.04), 2]
    near = spans[..., NEAR_END]
    assert near.min() == pytest.approx(20 * beside.block_size_m, rel=1e-3)
    assert 0 < (near < float("inf")).sum() < 16


def test_an_empty_volume_and_a_single_block(mapped):
    _, frames = mapped
    camera = frames[0].camera.resized(33, 21)
    assert not bool(numba_raycast(TsdfVolume(CONFIG), camera, torch.eye(4)).depth_m.any())
    volume = TsdfVolume(CONFIG)
    volume.add_blocks(torch.tensor([[0, 0, 6]]))
    number = torch.arange(512)
    volume.D[:] = 1.0 - ((number & 7) + 0.5) / 4.0
    volume.W[:] = 1.0
    T_WC = torch.eye(4)
    T_WC[:2, 3] = 0.08
    out = assert_same_picture(volume, camera, T_WC)
    middle = out.depth_m[10, 16]
    assert float(middle) == pytest.approx((48 + 4) * 0.02, abs=1e-5)
    assert out.normal_W[10, 16].tolist() == pytest.approx([0.0, 0.0, -1.0], abs=1e-5)


def test_a_map_too_large_for_a_table(mapped, monkeypatch):
    from gsfusion_nb.tsdf import octree

    volume, frames = mapped
    camera = frames[0].camera.resized(24, 18)
    expected = numba_raycast(volume, camera, frames[0].T_WC)
    monkeypatch.setattr(octree, "TABLE_NODES", 1)
    copy = TsdfVolume(CONFIG)
    copy.load_state_dict(volume.state_dict())
    assert copy.index.table is None
    got = numba_raycast(copy, camera, frames[0].T_WC)
    assert float(((got.depth_m - expected.depth_m).abs() > 1e-5).double().mean()) < 0.01
