"""What holds for every function that a notebook judges: plain results, time, no ready-made answer, nothing changed."""

import inspect
import itertools
import sys
import threading
import time

import numpy as np
import pytest
import torch

from gsfusion_nb.course import exercises, learner_code, tsdf
from gsfusion_nb.geometry import se3
from gsfusion_nb.optim import l1_vjp
from gsfusion_nb.tsdf import octree

ALL = exercises()


def says(name, function, words):
    """The verdict is red, and its sentence contains ``words``."""
    verdict = ALL[name](function)
    assert verdict.state == "failed", repr(verdict)
    assert words in repr(verdict), repr(verdict)
    assert verdict.detail


def block_of(xyz_W, voxel_size_m):
    return (xyz_W / (8 * voxel_size_m)).floor().long()


HANDED_IN = "it is your own code"


@pytest.mark.parametrize(
    ("name", "function", "words"),
    [
        pytest.param("block_of", tsdf._block_of, HANDED_IN, id="the solution, imported"),
        pytest.param("block_of", lambda x, s: tsdf._block_of(x, s), "the course's solution", id="a function around it"),
        pytest.param("l1_gradient", lambda a, b: l1_vjp(a, b), "does what this exercise asks", id="the operation"),
        pytest.param("l1_gradient", lambda a, b: inspect.unwrap(l1_vjp)(a, b), HANDED_IN, id="its reference"),
        pytest.param("morton_code", lambda *c: int(octree.encode(torch.tensor([c]))) - 7, HANDED_IN, id="the library"),
        pytest.param("invert_pose", lambda T: torch.linalg.inv(T), "it calls linalg_inv", id="a ready-made inverse"),
        pytest.param("invert_pose", lambda T: T.inverse(), "it calls inverse", id="as a method"),
        pytest.param("invert_pose", lambda T: se3.inverse(T), HANDED_IN, id="the library's inverse"),
        pytest.param("block_of", lambda x, s: itertools.count(), "more than 10,000 values", id="a list without end"),
        pytest.param("plan_frame", lambda *a: (object(),) * 3, "it returned a object", id="an object"),
        pytest.param("block_of", lambda x, s: sys.exit(0), "exit() or SystemExit; use return", id="exit"),
        pytest.param("block_of", lambda x, s: exec("raise KeyboardInterrupt"), "raised Keyboard", id="interrupt"),
        pytest.param("block_of", lambda x, s: torch.full((len(x), 3), torch.nan), "NaN", id="NaN"),
        pytest.param("block_of", lambda x, s: x.mul_(0).long(), "does not change its inputs", id="input changed"),
        pytest.param("project_points", lambda c, x: object.__setattr__(c, "fx", 0.0) or x[:, :2], "the camera that was",
                     id="camera changed"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_what_is_no_answer_of_ones_own_is_refused(name, function, words):
    says(name, function, words)


@pytest.mark.parametrize("name", ALL)
def test_nan_is_never_right(name):
    solution = inspect.unwrap(ALL[name]._solution)

    def spoiled(value):
        if isinstance(value, tuple):
            return tuple(map(spoiled, value))
        return value * torch.nan if isinstance(value, (float, torch.Tensor)) else float("nan")

    assert ALL[name](lambda *a, **k: spoiled(solution(*a, **k))).state == "failed"


def test_a_gradient_by_autograd_is_not_written_by_hand():
    def by_autograd(rgb, target):
        rgb = rgb.clone().requires_grad_()
        (rgb - target).abs().mean().backward()
        return rgb.grad

    says("l1_gradient", by_autograd, "it calls backward, which does what this exercise asks for; write it out")


def endless(xyz_W, voxel_size_m):
    while True:
        try:
            while True:
                pass
        except:  # noqa: E722
            if len(COUNTED) > 2:
                raise
            COUNTED.append(1)


COUNTED = []


def test_a_loop_without_end_is_left(monkeypatch):
    monkeypatch.setattr(learner_code, "_CROWDED", 1)
    for function in (endless, lambda x, s: time.sleep(0.9)):
        impatient = learner_code.Guard(limit_s=0.3)
        with pytest.raises(learner_code.Failed, match=r"it ran for more than 0\.3 s"):
            impatient.run(function, (torch.zeros(1, 3), 0.1), {})
    assert not [thread for thread in threading.enumerate() if thread.name == "learner"]


def test_recursion_without_end_is_the_students_error():
    def deeper(xyz_W, voxel_size_m):
        return deeper(xyz_W, voxel_size_m)

    says("block_of", deeper, "it raised RecursionError in line")


def test_the_stand_in_cannot_be_handed_in(capsys):
    for plain in (False, True):
        ours = ALL["average_loop"].working(lambda *a: None, plain=plain)
        says("average_loop", ours, "write your own")
        says("average_loop", lambda *a, ours=ours: ours(*a), "write your own")
        assert ours(np.zeros(1), np.zeros(1), np.zeros(1), 4.0)[1] == 1
    with pytest.raises(OSError, match="could not get source"):
        inspect.getsource(ours)
