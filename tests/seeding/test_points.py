"""Nearest points: all distances against the k-d tree."""

import pytest
import torch

from gsfusion_nb.seeding import points
from gsfusion_nb.seeding.points import by_all_distances, k_nearest


@pytest.mark.parametrize("k", [1, 4])
@pytest.mark.parametrize(("M", "N"), [(50, 300), (7, 2), (3, 1), (0, 5), (5, 0)])
def test_both_ways_agree(M, N, k, generator, monkeypatch):
    monkeypatch.setattr(points, "_DISTANCES", 1000)  # several pieces
    xyz, others = torch.randn(M, 3, generator=generator) + 20, torch.randn(N, 3, generator=generator) + 20
    distance, row = k_nearest(xyz, others, k)
    assert distance.shape == row.shape == (M, k)
    assert bool((distance[:, N:] == torch.inf).all())
    assert bool((row[:, N:] == N).all())
    if M and N:
        ours, at = by_all_distances(xyz, others, k)
        torch.testing.assert_close(ours, distance, rtol=1e-5, atol=1e-5)
        assert torch.equal(at, row)
        known = row[:, : min(k, N)]
        gap = (others[known] - xyz[:, None]).norm(dim=-1)
        torch.testing.assert_close(gap, distance[:, : known.shape[1]])
