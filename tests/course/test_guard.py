"""What holds for every function that a notebook judges: plain results, time, no ready-made answer, nothing changed."""

import inspect
import itertools
import sys
import threading
import time
import unittest.mock

import numpy as np
import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.course import check, exercises, guard, mine, progress, tsdf
from gsfusion_nb.geometry import se3
from gsfusion_nb.optim import l1_vjp
from gsfusion_nb.tsdf import morton

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
        pytest.param("morton_code", lambda *c: int(morton.encode(torch.tensor([c]))) - 7, HANDED_IN, id="the library"),
        pytest.param("invert_pose", lambda T: torch.linalg.inv(T), "it calls linalg_inv", id="a ready-made inverse"),
        pytest.param("invert_pose", lambda T: T.inverse(), "it calls inverse", id="as a method"),
        pytest.param("invert_pose", lambda T: se3.inverse(T), HANDED_IN, id="the library's inverse"),
        pytest.param("block_of", lambda x, s: check.block_of(block_of), "cannot ask a checker", id="the checker"),
        pytest.param("block_of", unittest.mock.MagicMock(), "expected [1, 3]", id="a mock"),
        pytest.param("block_of", lambda x, s: sys.exit(0), "exit() or SystemExit; use return", id="exit"),
        pytest.param("block_of", lambda x, s: exec("raise KeyboardInterrupt"), "raised Keyboard", id="interrupt"),
        pytest.param("block_of", lambda x, s: exec("raise GeneratorExit"), "raised GeneratorExit", id="GeneratorExit"),
        pytest.param("block_of", lambda x, s: torch.zeros(1).expand(10**12), "more than 10,000,000", id="enormous"),
        pytest.param("block_of", lambda x, s: np.broadcast_to(1.0, 10**12), "more than 10,000,000", id="array"),
        pytest.param("block_of", lambda x, s: torch.full((len(x), 3), torch.nan), "NaN", id="NaN"),
        pytest.param("block_of", lambda x, s: x.mul_(0).long(), "does not change its inputs", id="input changed"),
        pytest.param("project_points", lambda c, x: object.__setattr__(c, "fx", 0.0) or x[:, :2], "the camera that was",
                     id="camera changed"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_what_is_no_answer_of_ones_own_is_refused(name, function, words):
    says(name, function, words)


def test_a_list_without_end_is_refused(monkeypatch):
    monkeypatch.setattr(guard, "_LONGEST", 500)
    says("block_of", lambda x, s: itertools.count(), "it returned more than 500 numbers")


class AlwaysEqual(str):
    def __eq__(self, other):
        return True

    __hash__ = str.__hash__


class Yes:
    def __eq__(self, other):
        return True

    def __bool__(self):
        return True

    def __float__(self):
        return 0.0


class Agrees(torch.Tensor):
    """Answers each question about itself with what is asked for."""

    @classmethod
    def __torch_function__(cls, function, types, args=(), kwargs=None):
        return torch.zeros(1, 3)


class Five(float):
    def __float__(self):
        return 5.0

    def __sub__(self, other):
        return 0.0


def test_an_answer_that_is_equal_to_everything_is_not_right():
    says("next_state", lambda *a: AlwaysEqual("anything"), "got 'anything', expected 'becomes stable'")
    says("next_state", lambda *a: Yes(), "it returned a Yes; expected tensors, arrays, numbers")
    says("plan_frame", lambda *a: (Yes(), Yes(), Yes()), "it returned a Yes")
    says("block_of", lambda x, s: torch.full((1, 3), 7).as_subclass(Agrees), "got 7 at [0, 0], expected 0")
    says("attainable_gflops", lambda *a: Five(7.0), "got 7, expected 5")


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
    monkeypatch.setattr(guard, "_CROWDED", 1)
    for function in (endless, lambda x, s: time.sleep(0.9)):
        impatient = guard.Guard(limit_s=0.3)
        began = time.monotonic()
        with pytest.raises(guard.Broken, match=r"it ran for more than 0\.3 s"):
            impatient.run(function, (torch.zeros(1, 3), 0.1), {})
        assert time.monotonic() - began < 30
    assert not [thread for thread in threading.enumerate() if thread.name == "learner"]


def test_recursion_without_end_is_the_students_error():
    def deeper(xyz_W, voxel_size_m):
        return deeper(xyz_W, voxel_size_m)

    says("block_of", deeper, "it raised RecursionError in line")


def test_answers_remembered_by_input_come_from_no_earlier_run():
    """A table of the inputs that the checker showed before holds only what the function itself returned."""
    seen = {}

    def remembers(xyz_W, voxel_size_m):
        return seen.setdefault((tuple(xyz_W.flatten().tolist()), voxel_size_m), torch.zeros_like(xyz_W).long())

    for _ in range(3):
        says("block_of", remembers, "block k reaches from 8 k to 8 (k + 1) voxels")
    seen[next(iter(seen))].fill_(9)  # the checker keeps copies
    says("block_of", remembers, "got 9")


def test_random_numbers_and_settings_are_left_as_they_are():
    def sets_the_type(xyz_W, voxel_size_m):
        torch.set_default_dtype(torch.float64)
        return block_of(xyz_W, voxel_size_m)

    says("block_of", sets_the_type, "it changed torch's default type of numbers")
    assert torch.get_default_dtype() == torch.float32
    assert check.block_of(lambda x, s: (torch.manual_seed(1), block_of(x, s))[1])


def test_the_stand_in_cannot_be_handed_in(capsys):
    for plain in (False, True):
        ours = ALL["average_loop"].working(lambda *a: None, plain=plain)
        says("average_loop", ours, "write your own")
        says("average_loop", lambda *a, ours=ours: ours(*a), "write your own")
        assert ours(np.zeros(1), np.zeros(1), np.zeros(1), 4.0)[1] == 1
    with pytest.raises(OSError, match="could not get source"):
        inspect.getsource(ours)


def test_progress_written_by_hand_keeps_no_function(monkeypatch, tmp_path):
    monkeypatch.setenv("GSNB_COURSE_FILE", str(tmp_path / "course.json"))
    mine.forget()
    wrong = "def l1_gradient(rgb, target):\n    return rgb\n"
    progress.note("exercises", "l1_gradient", tries=1, passed=progress.now())
    progress.note("functions", "l1_gradient", function="l1_gradient", source=wrong, kept=progress.now())
    mine.load()
    assert "l1_gradient" not in mine.kept()
    with use_backend("mine"):
        l1_vjp(torch.ones(2, 2, 3), torch.zeros(2, 2, 3))
