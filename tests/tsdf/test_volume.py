import dataclasses

import pytest
import torch

from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import TsdfVolume, estimate_memory
from gsfusion_nb.tsdf.block_pool import BLOCKS_IN_BOX
from gsfusion_nb.tsdf.cells import corner_gradients, corner_weights
from gsfusion_nb.tsdf.voxels import block_corners, voxel_at, voxel_centres, voxels_of

CONFIG = TsdfConfig(voxel_size_m=0.02, truncation_voxels=4.0)


def test_new_blocks_are_unobserved():
    volume = TsdfVolume(CONFIG)
    rows = volume.add_blocks(torch.tensor([[0, 0, 0], [-1, 2, 3], [0, 0, 0]]))
    assert sorted(rows.tolist()) == [0, 1]
    assert volume.n_blocks == 2
    assert bool((volume.D == 1).all())
    assert bool((volume.W == 0).all())
    assert bool((volume.rgb == 0).all())
    assert volume.rgb.shape == (2, 512, 3)
    assert volume.index.find(volume.block_coords).tolist() == [0, 1]
    assert volume.add_blocks(torch.tensor([[0, 0, 0]])).tolist() == []


def test_values_survive_growth(generator):
    volume = TsdfVolume(CONFIG)
    first = volume.add_blocks(torch.tensor([[7, 7, 7]]))
    volume.D[first] = 0.25
    volume.W[first] = 3.0
    for i in range(6):
        volume.add_blocks(torch.randint(-40, 40, (900, 3), generator=generator) + 100 * i)
    assert volume.n_blocks > 4000
    row = volume.index.find(torch.tensor([[7, 7, 7]]))
    assert bool((volume.D[row] == 0.25).all())
    assert bool((volume.W[row] == 3).all())
    assert float(volume.W.sum()) == 3 * 512


def test_boxes_of_blocks_follow_the_pool(generator):
    volume = TsdfVolume(CONFIG)
    assert len(volume.pool.boxes(volume.n_blocks)) == 0
    for n in (5, 59, 1, 0, 200):
        volume.add_blocks(torch.randint(-400, 400, (n, 3), generator=generator))
        parts = volume.block_coords.split(BLOCKS_IN_BOX)
        assert volume.pool.boxes(volume.n_blocks).tolist() == [
            [x.amin(0).tolist(), x.amax(0).tolist()] for x in parts
        ]
    loaded = TsdfVolume(CONFIG)
    loaded.load_state_dict(volume.state_dict())
    n = volume.n_blocks
    assert loaded.pool.boxes(n).tolist() == volume.pool.boxes(n).tolist()


@pytest.mark.parametrize("limit", [None, 10_000])
def test_the_pool_is_copied_seldom_also_near_the_limit(limit):
    volume = TsdfVolume(
        CONFIG, memory_limit_bytes=limit and estimate_memory(limit, weighs_colours=True)
    )
    pools = set()
    for i in range(95):
        volume.add_blocks(torch.tensor([[x, i, 0] for x in range(100)]))
        pools.add(volume.D.data_ptr())
    assert len(pools) < 12


def test_refuses_to_outgrow_memory():
    volume = TsdfVolume(CONFIG, memory_limit_bytes=estimate_memory(10, weighs_colours=True))
    volume.add_blocks(torch.tensor([[i, 0, 0] for i in range(10)]))
    with pytest.raises(MemoryError, match=r"needs 0 MB for 11 blocks .* use larger voxels"):
        volume.add_blocks(torch.tensor([[0, 1, 0]]))
    assert volume.n_blocks == 10
    assert volume.index.find(torch.tensor([[0, 1, 0]])).tolist() == [-1]


@pytest.mark.parametrize(
    "block",
    [(0, 0, 0), (-4, 3, -60), (9000, -9000, 2)],
)
def test_sample_nearest(block):
    volume = TsdfVolume(CONFIG)
    row = int(volume.add_blocks(torch.tensor([block]))[0])
    volume.D[row] = torch.arange(512.0)
    volume.W[row] = 2.0
    volume.rgb[row, :, 1] = torch.arange(512.0) / 512
    corner = torch.tensor(block).double() * volume.block_size_m
    # Voxel (1, 2, 3) spans [1, 2) x [2, 3) x [3, 4) voxels and is number 64 + 16 + 3.
    inside = (
        torch.tensor([[1.1, 2.1, 3.1], [1.9, 2.9, 3.9], [8.5, 0.5, 0.5]]).double() * 0.02 + corner
    )
    s = volume.sample_nearest(inside.float())
    assert s.D.tolist() == [83.0, 83.0, 1.0]
    assert s.W.tolist() == [2.0, 2.0, 0.0]
    torch.testing.assert_close(
        s.rgb[:, 1],
        torch.tensor([83 / 512, 83 / 512, 0.0]),
    )
    assert volume.sample_nearest(torch.zeros(0, 3)).rgb.shape == (0, 3)


def test_interpolation_is_exact_on_a_linear_field(filled_volume, generator):
    def field(p):
        return 0.02 * (p[..., 0] - 2 * p[..., 1] + 0.5 * p[..., 2]) + 0.004

    volume = filled_volume(
        field,
        (-2, -2, -2),
        (2, 2, 2),
    )
    p = (torch.rand(500, 3, generator=generator) * 2 - 1) * 0.3
    D, valid = volume.interpolate(p)
    assert bool(valid.all())
    torch.testing.assert_close(
        D * CONFIG.truncation_m,
        field(p),
        atol=1e-6,
        rtol=0,
    )


def test_interpolation_needs_eight_observed_voxels(filled_volume):
    volume = filled_volume(
        lambda p: p[..., 0] * 0.1,
        (0, 0, 0),
        (2, 2, 2),
    )
    volume.W[0, 0] = 0.0
    centre = torch.tensor(
        [[0.01, 0.01, 0.01], [0.031, 0.031, 0.031], [0.005, 0.1, 0.1], [0.16, 0.16, 0.16]]
    )
    D, valid = volume.interpolate(centre)
    # beside the unobserved voxel; one voxel on; at the edge of the allocated box; where eight
    # blocks meet
    assert valid.tolist() == [False, True, False, True]
    assert D[[0, 2]].tolist() == [1.0, 1.0]


def test_state_round_trip(filled_volume):
    volume = filled_volume(
        lambda p: p[..., 2] - 0.05,
        (-3, 0, -1),
        (1, 2, 2),
    )
    copy = TsdfVolume(CONFIG)
    copy.load_state_dict(volume.state_dict())
    for name in ("D", "W", "rgb", "block_coords"):
        assert torch.equal(getattr(copy, name), getattr(volume, name)), name
    assert copy.index.find(volume.block_coords).tolist() == list(range(volume.n_blocks))
    with pytest.raises(ValueError, match="saved map was made with"):
        TsdfVolume(TsdfConfig(voxel_size_m=0.5)).load_state_dict(volume.state_dict())
    empty = TsdfVolume(CONFIG)
    empty.load_state_dict(TsdfVolume(CONFIG).state_dict())
    assert empty.n_blocks == 0


def test_centres_and_corners_by_hand():
    volume = TsdfVolume(CONFIG)
    volume.add_blocks(torch.tensor([[-1, 0, 2]]))
    centres = voxel_centres(voxels_of(volume.block_coords), volume.config.voxel_size_m)
    assert centres.dtype == torch.float64
    torch.testing.assert_close(
        centres[0, 83],
        torch.tensor([-0.16 + 0.03, 0.05, 0.32 + 0.07]).double(),
    )
    coords = voxels_of(volume.block_coords[torch.tensor([0])])
    assert coords[0, 83].tolist() == [-8 + 1, 2, 16 + 3]
    assert volume.find_voxels(coords[0]).tolist() == list(range(512))
    assert torch.equal(voxel_at(volume.block_coords, torch.arange(512)), coords[0])
    corners = block_corners(volume.block_coords, volume.block_size_m)[0]
    torch.testing.assert_close(corners[0b101], torch.tensor([0.0, 0.0, 0.48]).double())


def test_weights_of_a_cell_and_their_derivatives(generator):
    f = torch.rand(20, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    weights = corner_weights(f)
    torch.testing.assert_close(weights.sum(1), torch.ones(20).double())
    torch.testing.assert_close(
        weights[:, 0b110],
        (1 - f[:, 0]) * f[:, 1] * f[:, 2],
    )
    for corner in range(8):
        (expected,) = torch.autograd.grad(weights[:, corner].sum(), f, retain_graph=True)
        torch.testing.assert_close(corner_gradients(f)[:, corner], expected)


@pytest.mark.parametrize(
    ("by_distance", "band_voxels", "weighs_colours"),
    [(False, 0.0, False), (True, 0.0, True), (False, 1.5, True)],
)
def test_memory_is_what_the_tensors_take(by_distance, band_voxels, weighs_colours):
    config = dataclasses.replace(
        CONFIG, colour_by_distance=by_distance, colour_band_voxels=band_voxels
    )
    volume = TsdfVolume(config)
    volume.add_blocks(torch.tensor([[i, 0, 0] for i in range(10)]))
    tensors = [x for x in volume.state_dict().values() if isinstance(x, torch.Tensor)]
    taken = sum(x.numel() * x.element_size() for x in tensors)
    assert estimate_memory(10, weighs_colours=weighs_colours) == taken


def test_how_much_memory_is_needed_and_allowed():
    """2,000 blocks of 512 voxels of 24 bytes, and 12 bytes for their place: 24.6 million bytes."""
    volume = TsdfVolume(CONFIG, memory_limit_bytes=20_400_000)
    with pytest.raises(
        MemoryError, match=r"needs 25 MB for 2000 blocks .* of 0.02 m, but only 20 MB may be used"
    ):
        volume.add_blocks(torch.tensor([[i, 0, 0] for i in range(2000)]))
    assert volume.n_blocks == 0


@pytest.mark.parametrize(
    ("name", "change", "sentence"),
    [
        ("W", lambda x: x - 1, "W must be at least 0 in every voxel, got -1"),
        ("W_rgb", lambda x: x - 2, "W_rgb must be at least 0 in every voxel, got -2"),
        ("block_coords", lambda x: x * 0, "block_coords must contain every block once"),
        ("D", lambda x: x / 0, "D"),
        ("rgb", lambda x: x[:, :2], "rgb"),
    ],
)
def test_a_damaged_map_is_refused(name, change, sentence):
    volume = TsdfVolume(CONFIG)
    volume.add_blocks(torch.tensor([[0, 0, 0], [1, 0, 0]]))
    state = volume.state_dict()
    with pytest.raises(ValueError, match=sentence):
        TsdfVolume(CONFIG).load_state_dict(state | {name: change(state[name])})
    with pytest.raises(
        ValueError, match=r"the saved map was made with .*0.02.*, this volume has .*0.03"
    ):
        TsdfVolume(dataclasses.replace(CONFIG, voxel_size_m=0.03)).load_state_dict(state)
