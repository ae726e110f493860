"""Chapter 8's solutions against the library: they are the parts of its ICP."""

import torch

from gsfusion_nb.course import exercises
from gsfusion_nb.geometry import se3

SOLUTIONS = {name: e._solution for name, e in exercises().items() if e.chapter == 8}


def test_a_few_steps_of_the_students_icp_arrive(generator):
    """Three planes; steps of the exercises, with true partners, find the pose."""
    n = torch.eye(3, dtype=torch.float64).repeat_interleave(20, 0)
    p = torch.rand(60, 3, generator=generator, dtype=torch.float64)
    true = se3.exp(torch.tensor([0.3, -0.2, 0.1, 0.2, -0.1, 0.3], dtype=torch.float64))
    q = se3.apply(true, p)
    n_W = n @ true[:3, :3].T
    T = se3.exp(torch.tensor([0.05, 0.02, -0.04, 0.1, 0.05, -0.1], dtype=torch.float64)) @ true
    for _ in range(6):
        T = SOLUTIONS["gauss_newton"](T, *SOLUTIONS["point_to_plane"](se3.apply(T, p), q, n_W))
    assert torch.allclose(T, true, atol=1e-6)


def test_a_spread_correction_does_not_stretch_the_steps_of_a_straight_path():
    path = torch.eye(4, dtype=torch.float64).repeat(11, 1, 1)
    path[:, 0, 3] = torch.linspace(0, 5, 11)
    end = path[-1].clone()
    end[2, 3] = 0.5
    corrected = SOLUTIONS["spread_correction"](path, end)
    steps = (corrected[1:, :3, 3] - corrected[:-1, :3, 3]).norm(dim=1)
    assert float(steps.max() - steps.min()) < 1e-6
