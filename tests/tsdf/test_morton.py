import pytest
import torch

from gsfusion_nb.tsdf import morton


def test_by_hand():
    o = morton.OFFSET
    coords = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [5, 3, 6]]) - o
    # 5 = 101, 3 = 011, 6 = 110 -> bits (z y x) from the top: 1 0 1, 1 1 0, 0 1 1 -> 0b101110011
    assert morton.encode(coords).tolist() == [0, 1, 2, 4, 0b101110011]


def test_round_trip(generator):
    edge = morton.OFFSET
    coords = torch.randint(-edge, edge, (5000, 3), generator=generator)
    coords = torch.cat([coords, torch.tensor([[-edge] * 3, [edge - 1] * 3, [0, -1, 1]])])
    codes = morton.encode(coords)
    assert bool((codes >= 0).all())
    assert torch.equal(morton.decode(codes), coords)
    assert morton.decode(morton.encode(coords.to(torch.int32))).dtype == torch.int64


def test_parent_holds_its_eight_children():
    block = torch.tensor([[-3, 4, 7]])
    children = torch.tensor([[2 * -3 + (c & 1), 8 + (c >> 1 & 1), 14 + (c >> 2)] for c in range(8)])
    parents = morton.encode(children) >> 3
    # One level up, coordinates and their offset are halved.
    expected = morton.encode(block + morton.OFFSET // 2 - morton.OFFSET)
    assert parents.tolist() == expected.expand(8).tolist()
    assert (morton.encode(children) & 7).tolist() == list(range(8))


def test_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match=r"must lie in \[-1048576, 1048576\), got 0 to 1048576"):
        morton.encode(torch.tensor([[0, 0, morton.OFFSET]]))
    assert morton.encode(torch.zeros(0, 3, dtype=torch.int64)).shape == (0,)
