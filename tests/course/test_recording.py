"""Chapter 11's solutions on numbers that they were not written for."""

import pytest
import torch

from gsfusion_nb.course import exercises
from gsfusion_nb.geometry import se3

SOLUTIONS = {name: e._solution for name, e in exercises().items() if e.chapter == 11}


@pytest.mark.parametrize("factor", [0.2, 1.0, 4.2])
def test_the_unit_is_found_for_any_motion(factor, generator):
    T = se3.exp(0.4 * torch.randn(6, generator=generator, dtype=torch.float64))
    a = torch.rand(20, 3, generator=generator, dtype=torch.float64)
    found = SOLUTIONS["depth_factor"](
        a / factor,
        se3.apply(T, a) / factor,
        T[:3, :3],
        T[:3, 3],
    )
    assert float(found) == pytest.approx(factor)


@pytest.mark.parametrize("k", [-4, -1, 0, 3])
def test_the_shift_is_found_in_other_units(k, generator):
    curve = torch.rand(60, generator=generator)
    assert (
        SOLUTIONS["pose_shift"](
            17 * curve[5:45] + 1,
            0.3 * curve[5 - k : 45 - k],
            4,
        )
        == k
    )


def test_points_that_are_flat_can_be_told_apart(generator):
    flat = torch.rand(100, 3, generator=generator, dtype=torch.float64) * torch.tensor(
        [2.0, 2.0, 0.0]
    )
    T = se3.exp(torch.tensor([0.1, 0.2, 0.3, 0.3, -0.2, 0.1], dtype=torch.float64))
    assert SOLUTIONS["tell_apart"](flat, se3.apply(T, flat), T, 0.001) == "fits"
    assert (
        SOLUTIONS["tell_apart"](
            flat,
            se3.apply(T, flat),
            torch.eye(4, dtype=torch.float64),
            0.001,
        )
        == "poses"
    )
