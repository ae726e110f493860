"""One number for a voxel: the same groups, in the same order, as torch finds among its rows."""

import torch

from gsfusion_nb.geometry.voxel_keys import voxel_keys

FARTHEST = 2**20


def test_groups_and_their_order_are_those_of_the_rows(generator):
    ijk = torch.randint(-4, 4, (300, 3), generator=generator)
    ijk[:2] = torch.tensor([[-FARTHEST] * 3, [FARTHEST - 1] * 3])
    _, of_rows = torch.unique(ijk, dim=0, return_inverse=True)
    keys, of_keys = voxel_keys(ijk).unique(return_inverse=True)
    assert torch.equal(of_keys, of_rows)
    assert keys[0] >= 0


def test_voxels_beyond_the_largest_grid_share_a_number():
    ijk = torch.tensor([[3, -7, 11], [3, -7 + 2 * FARTHEST, 11], [3, -6, 11]])
    first, again, other = voxel_keys(ijk).tolist()
    assert first == again != other
