import dataclasses

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.geometry import backproject, pixel_grid, se3
from gsfusion_nb.tsdf import TsdfVolume, allocate, band_blocks
from gsfusion_nb.tsdf.allocate import crossed_cells, has_support

CONFIG = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0)


def sampled_blocks(frame, config, n=200):
    """Blocks at n points along every pixel's band, in float64."""
    d = frame.depth_m.double()
    ray = backproject(
        frame.camera, pixel_grid(frame.camera, dtype=torch.float64), torch.ones_like(d)
    )
    half = (
        config.truncation_m
        / (ray.norm(dim=-1) if config.sdf == "ray" else 1.0)
        * torch.ones_like(d)
    )
    keep = (d >= config.near_m) & (d <= config.far_m)
    found = set()
    for s in torch.linspace(-1, 1, n, dtype=torch.float64).tolist():
        p = se3.apply(
            frame.T_WC.double(),
            ray * (d + s * half)[..., None],
        )[keep]
        found |= set(
            map(
                tuple,
                (p / (8 * config.voxel_size_m)).floor().long().unique(dim=0).tolist(),
            )
        )
    return found


@pytest.mark.parametrize("sdf", ["z", "ray"])
@pytest.mark.parametrize("truncation_voxels", [1.0, 4.0, 10.0])
def test_no_block_is_missed(sdf, truncation_voxels, camera, look_from, sphere_depth, make_frame):
    small = camera.resized(40, 30)
    T_WC = look_from((1.1, -0.7, 0.9))
    frame = make_frame(sphere_depth(small, T_WC), small, T_WC)
    config = dataclasses.replace(
        CONFIG, sdf=sdf, truncation_voxels=truncation_voxels, outlier_guard=False
    )
    blocks = band_blocks(TsdfVolume(config), frame)
    got = set(map(tuple, blocks.tolist()))
    expected = sampled_blocks(frame, config)
    assert len(got) == blocks.shape[0]
    assert len(expected - got) <= 1  # knife edges: float32 here, float64 there
    # Dense sampling itself can miss a corner shorter than its spacing; more than a few would be
    # blocks too many.
    assert len(got - expected) <= 0.02 * len(expected) + 1


def test_one_pixel_by_hand(make_frame, camera):
    depth = torch.zeros(120, 160)
    depth[57, 82] = 1.0  # its centre (82.5, 57.5) lies 0.5 pixels left of the axis
    volume = TsdfVolume(dataclasses.replace(CONFIG, outlier_guard=False, sdf="z"))
    rows = allocate(volume, make_frame(depth, camera))
    # z from 0.92 to 1.08 in blocks of 0.16: 5.75 to 6.75; x = -0.5 / 140 m is just below 0, y is on
    # the axis
    assert volume.block_coords[rows].tolist() == [[-1, 0, 5], [-1, 0, 6]]
    assert allocate(volume, make_frame(depth, camera)).tolist() == []


def test_depth_limits(camera, make_frame):
    for depth, expected in ((0.39, False), (0.41, True), (5.9, True), (6.1, False), (0.0, False)):
        volume = TsdfVolume(CONFIG)
        allocate(volume, make_frame(torch.full((120, 160), depth), camera))
        assert (volume.n_blocks > 0) == expected, depth


def test_isolated_pixels_allocate_nothing(camera, make_frame):
    depth = torch.full((120, 160), 2.0)
    clean = TsdfVolume(CONFIG)
    spotted = TsdfVolume(CONFIG)
    naive = TsdfVolume(dataclasses.replace(CONFIG, outlier_guard=False))
    allocate(clean, make_frame(depth, camera))
    depth[20, 30] = 0.8
    depth[119, 0] = 4.0
    depth[70, 159] = 1.0
    allocate(spotted, make_frame(depth, camera))
    allocate(naive, make_frame(depth, camera))
    assert set(map(tuple, spotted.block_coords.tolist())) <= set(
        map(tuple, clean.block_coords.tolist())
    )
    assert naive.n_blocks > clean.n_blocks


def test_support_by_hand():
    depth = torch.tensor([[1.0, 2.0, 0.0, 3.0], [5.0, 9.0, 1.04, 8.0], [5.1, 0.0, 0.0, 3.1]])
    # 5.0 and 5.1 support each other; 1.0 and 1.04 are two columns apart, 3.0 and 3.1 two rows;
    # missing never counts
    expected = torch.zeros(3, 4, dtype=torch.bool)
    expected[1, 0] = expected[2, 0] = True
    assert torch.equal(has_support(depth), expected)
    diagonal = torch.tensor([[0.0, 1.0], [1.02, 0.0]])
    assert torch.equal(has_support(diagonal), diagonal > 0)
    assert has_support(torch.ones(1, 1)).tolist() == [[False]]
    assert has_support(torch.ones(1, 3)).tolist() == [[True] * 3]


def test_cells_of_a_segment_by_hand():
    """In x the walls are passed at t = 0.5 and 1.5, in y at 1; the second one runs backwards
    through one cell."""
    origin = torch.tensor([0.5, 0.5, 0.5])
    direction = torch.tensor([[1.0, 0.5, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    cells = crossed_cells(
        origin,
        direction,
        torch.zeros(3),
        torch.tensor([2.0, 0.6, 9.0]),
    )
    assert cells.tolist() == [[-1, 0, 0], [0, 0, 0], [1, 0, 0], [1, 1, 0], [2, 1, 0]]
    diagonal = crossed_cells(
        origin,
        torch.tensor([[1.0, 1.01, 1.02]]),
        torch.zeros(1),
        torch.ones(1),
    )
    assert diagonal.tolist() == [
        [0, 0, 0],
        [0, 0, 1],
        [0, 1, 1],
        [1, 1, 1],
    ]  # z first, then y, then x
    assert crossed_cells(
        origin,
        direction[:0],
        torch.zeros(0),
        torch.zeros(0),
    ).shape == (0, 3)


def test_empty_depth_and_bad_pose(camera, make_frame):
    volume = TsdfVolume(CONFIG)
    assert allocate(volume, make_frame(torch.zeros(120, 160), camera)).shape == (0,)
    pose = torch.eye(4)
    pose[0, 3] = float("nan")
    with pytest.raises(ValueError, match="T_WC must be finite"):
        allocate(volume, make_frame(torch.ones(120, 160), camera, pose))
    assert volume.n_blocks == 0


def test_shifted_world_shifts_the_blocks(camera, look_from, sphere_depth, make_frame):
    T_WC = look_from((0.9, 1.2, -0.4))
    depth = sphere_depth(camera, T_WC)
    moved = T_WC.clone()
    moved[:3, 3] += torch.tensor([-1024.0, 512.0, -256.0])
    config = dataclasses.replace(CONFIG, voxel_size_m=1 / 64)
    here = band_blocks(TsdfVolume(config), make_frame(depth, camera, T_WC))
    there = band_blocks(TsdfVolume(config), make_frame(depth, camera, moved)) - torch.tensor(
        [-8192, 4096, -2048]
    )
    a = set(map(tuple, here.tolist()))
    b = set(map(tuple, there.tolist()))
    assert len(a ^ b) <= 0.01 * len(a)  # the pose itself is float32: 60 micrometres there


@pytest.mark.parametrize("backend", ["reference", "numba"])
@pytest.mark.parametrize(
    "change",
    [{"cx": 2.0**31}, {"cy": -(2.0**31)}, {"fx": 1e-3}],
)
def test_rays_that_would_cross_millions_of_blocks_are_refused(camera, make_frame, backend, change):
    small = camera.resized(40, 30)
    frame = make_frame(
        torch.full((30, 40), 1.5),
        dataclasses.replace(small, **change),
    )
    message = r"the frame's camera: f. = .* m sideways per metre of depth"
    with use_backend(backend), pytest.raises(ValueError, match=message):
        band_blocks(TsdfVolume(CONFIG), frame)


def test_a_segment_beyond_the_index_is_refused_at_once():
    direction = torch.tensor([[1.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match="lies beyond the voxel index"):
        crossed_cells(
            torch.zeros(3),
            direction,
            torch.zeros(1),
            torch.tensor([3e9]),
        )
    with pytest.raises(ValueError, match="lies beyond the voxel index"):
        crossed_cells(
            torch.zeros(3),
            direction * torch.nan,
            torch.zeros(1),
            torch.ones(1),
        )
