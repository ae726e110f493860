"""The examination: recordings are written and read, each has its fault, and the solution's gradient is right."""

import dataclasses
from itertools import pairwise

import exam
import pytest
import torch

from gsfusion_nb.course.gradient_check import compare_gradients
from gsfusion_nb.types import Camera, Frame

F64 = torch.float64


def wall(k: int) -> Frame:
    """A wall 2 m in front of a camera that moves to the right."""
    pose = torch.eye(4)
    pose[0, 3] = 0.05 * k
    camera = Camera(width=16, height=12, fx=8.0, fy=8.0, cx=8.0, cy=6.0)
    rgb = torch.full((12, 16, 3), 20 * k, dtype=torch.uint8)
    return Frame(index=k, timestamp_s=k / 2, rgb=rgb, depth_m=torch.full((12, 16), 2.0), camera=camera, T_WC=pose)


def test_every_fault_is_undone_by_its_repair():
    frames = [wall(k) for k in range(8)]
    frames[0] = dataclasses.replace(frames[0], depth_m=torch.full((12, 16), 2.5))
    repairs = {"a": "range to z", "c": "as it is", "d": "poses inverted", "e": "depth / 0.9"}
    for letter, name in repairs.items():
        broken = [exam.FAULTS[letter][1](b, a) for a, b in pairwise(frames)]
        assert all(torch.equal(a.T_WC, b.T_WC) for a, b in zip(broken, frames[1:], strict=True)) == (letter != "d")
        for repaired, frame in zip(exam.REPAIRS[name](broken), frames[1:], strict=True):
            torch.testing.assert_close(repaired.depth_m, frame.depth_m)
            torch.testing.assert_close(repaired.T_WC, frame.T_WC)
    late = [exam.FAULTS["b"][1](b, a) for a, b in pairwise(frames)]
    back = exam.REPAIRS["pose of the next frame"](late)
    assert all(torch.equal(a.T_WC, b.T_WC) for a, b in zip(back, frames[1:-1], strict=True))


def test_views_of_one_wall_agree_and_a_tilted_pose_is_seen():
    frames = [wall(k) for k in range(8)]
    assert exam.disagreement_mm(frames) == pytest.approx(0, abs=1e-3)
    nearer = [dataclasses.replace(f, depth_m=f.depth_m - 0.01 * f.index) for f in frames]
    assert exam.disagreement_mm(nearer) == pytest.approx(30, rel=1e-3)


def test_the_gradient_of_the_blended_depth_is_right():
    alpha, z = torch.tensor([0.5, 0.2, 0.9], dtype=F64), torch.tensor([1.0, 2.0, 1.5], dtype=F64)
    assert compare_gradients(
        exam.blended_depth, lambda v, a, d: exam.blended_depth_vjp(a, d, v), {"alpha": alpha, "z": z}
    )
    flat = exam.blended_depth_vjp(alpha, torch.full_like(z, 2.0), torch.tensor(1.0, dtype=F64))[0]
    assert float(flat.abs().max()) < 1e-12
