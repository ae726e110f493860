"""Gaps around new points: hand-made layouts, and a loop over all pairs as witness."""

import math

import pytest
import torch

from gsfusion_nb.seeding.rules.rtg_slam import BORDER_M, gaps_around, nearest

NONE = torch.zeros(0, 3), torch.zeros(0)


def grid(n: int, spacing: float) -> torch.Tensor:
    a = torch.arange(n) * spacing
    return torch.stack([*torch.meshgrid(a, a, indexing="ij"), torch.zeros(n, n)], dim=-1).reshape(-1, 3)


def test_the_middle_of_a_grid_is_as_wide_as_its_spacing():
    size = gaps_around(grid(5, 0.02), *NONE).size_m.view(5, 5)
    torch.testing.assert_close(size[1:-1, 1:-1], torch.full((3, 3), 0.02))
    # a corner has neighbours at 1, 1 and sqrt(2) spacings: sqrt((1 + 1 + 2) / 3)
    assert float(size[0, 0]) == pytest.approx(0.02 * math.sqrt(4 / 3), rel=1e-5)


def test_by_hand_with_an_existing_disc():
    """Points at x = 0, 0.1, 0.3; a disc of radius 0.03 at x = 0.14 covers 0.05 .. 0.23."""
    xyz = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.3, 0, 0]])
    gaps = gaps_around(xyz, torch.tensor([[0.14, 0.0, 0.0]]), torch.tensor([0.03]))
    expected = [[0.05, 0.1, 0.3], [-0.05, 0.1, 0.2], [0.07, 0.2, 0.3]]
    torch.testing.assert_close(gaps.gap_m.sort(dim=1).values, torch.tensor(expected))
    assert gaps.overlaps.tolist() == [False, True, False]
    rms = [math.sqrt(sum(max(g, 0.0) ** 2 for g in row) / 3) for row in expected]
    torch.testing.assert_close(gaps.size_m, torch.tensor(rms))


@pytest.mark.parametrize("copies", [2, 3, 4, 6])
def test_duplicates_are_each_others_neighbours_and_never_their_own(copies):
    xyz = torch.cat([torch.zeros(copies, 3), torch.tensor([[0.5, 0, 0], [0, 0.7, 0], [0, 0, 0.9]])])
    gaps = gaps_around(xyz, *NONE).gap_m[:copies].sort(dim=1).values
    zeros = min(copies - 1, 3)
    expected = ([0.0] * zeros + [0.5, 0.7, 0.9])[:3]
    torch.testing.assert_close(gaps, torch.tensor([expected]).repeat(copies, 1))


def brute_force(xyz, other, radius, reach: float, k: int) -> torch.Tensor:
    """Distances to every other centre in the padded box, less the reach of the k nearest."""
    low, high = xyz.amin(0) - BORDER_M, xyz.amax(0) + BORDER_M
    rows = []
    for i in range(len(xyz)):
        found = [(float((xyz[i] - xyz[j]).norm()), 0.0) for j in range(len(xyz)) if j != i]
        for x, r in zip(other, radius, strict=True):
            if ((x >= low) & (x <= high)).all():
                found.append((float((xyz[i] - x).norm()), float(r)))
        rows.append([d - reach * r for d, r in sorted(found)[:k]])
    return torch.tensor(rows)


@pytest.mark.parametrize(("m", "n"), [(2, 5), (30, 0), (25, 40)])
def test_agrees_with_a_loop_over_all_pairs(generator, m, n):
    xyz = torch.rand(m, 3, generator=generator) * 0.3
    other = torch.rand(n, 3, generator=generator) * 0.6 - 0.15
    radius = torch.rand(n, generator=generator) * 0.03
    gaps = gaps_around(xyz, other, radius)
    torch.testing.assert_close(gaps.gap_m, brute_force(xyz, other, radius, 3.0, 3), atol=1e-6, rtol=1e-5)


def test_distant_discs_do_not_count():
    """One 6 cm beyond the points' box, however large."""
    gaps = gaps_around(torch.tensor([[0.0, 0, 0], [0.1, 0, 0]]), torch.tensor([[0.161, 0.0, 0.0]]), torch.ones(1))
    torch.testing.assert_close(gaps.gap_m, torch.full((2, 1), 0.1))


def test_nearest_by_a_loop(generator):
    xyz, other = torch.rand(20, 3, generator=generator), torch.rand(30, 3, generator=generator)
    distance, row = nearest(xyz, other)
    everything = (xyz[:, None] - other[None]).norm(dim=-1)
    expected = everything.sort(dim=1)
    torch.testing.assert_close(distance, expected.values[:, :3])
    assert torch.equal(row, expected.indices[:, :3])
    assert torch.equal(nearest(xyz, other, 1)[1], expected.indices[:, :1])
