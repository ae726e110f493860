"""Nearest points: the k-d tree against all distances."""

import pytest
import torch

from gsfusion_nb.seeding.points import k_nearest


@pytest.mark.parametrize("k", [1, 4])
@pytest.mark.parametrize(
    ("M", "N"),
    [(50, 300), (7, 2), (3, 1), (0, 5), (5, 0)],
)
def test_the_nearest_are_those_of_all_distances(M, N, k, generator):
    xyz = torch.randn(M, 3, generator=generator) + 20
    others = torch.randn(N, 3, generator=generator) + 20
    distance, row = k_nearest(xyz, others, k)
    assert distance.shape == row.shape == (M, k)
    assert bool((distance[:, N:] == torch.inf).all())
    assert bool((row[:, N:] == N).all())
    ours, at = (xyz[:, None] - others).norm(dim=-1).topk(min(k, N), largest=False)
    torch.testing.assert_close(ours, distance[:, :N])
    assert torch.equal(at, row[:, :N])
