"""What holds for every function that a notebook judges: plain results, time, nothing changed."""

import contextlib
import inspect
import itertools
import time

import pytest
import torch

from gsfusion_nb.course import exercises, learner_code

ALL = exercises()


def says(name, function, words):
    """The verdict is red, and its sentence contains ``words``."""
    verdict = ALL[name](function)
    assert verdict.state == "failed", repr(verdict)
    assert words in repr(verdict), repr(verdict)
    assert verdict.detail


def block_of(xyz_W, voxel_size_m):
    return (xyz_W / (8 * voxel_size_m)).floor().long()


@pytest.mark.parametrize(
    ("name", "function", "words"),
    [
        pytest.param(
            "block_of",
            lambda x, s: itertools.count(),
            "more than 10,000 values",
            id="a list without end",
        ),
        pytest.param(
            "plan_frame", lambda *a: (object(),) * 3, "it returned a object", id="an object"
        ),
        pytest.param("block_of", lambda x, s: torch.full((len(x), 3), torch.nan), "NaN", id="NaN"),
        pytest.param(
            "block_of",
            lambda x, s: x.mul_(0).long(),
            "does not change its inputs",
            id="input changed",
        ),
        pytest.param(
            "project_points",
            lambda c, x: object.__setattr__(c, "fx", 0.0) or x[:, :2],
            "the camera that was",
            id="camera changed",
        ),
    ],
)
def test_what_is_no_plain_answer_is_refused(name, function, words):
    says(name, function, words)


@pytest.mark.parametrize("name", ALL)
def test_nan_is_never_right(name):
    solution = inspect.unwrap(ALL[name]._solution)

    def spoiled(value):
        if isinstance(value, tuple):
            return tuple(map(spoiled, value))
        return value * torch.nan if isinstance(value, (float, torch.Tensor)) else float("nan")

    assert ALL[name](lambda *a, **k: spoiled(solution(*a, **k))).state == "failed"


def endless(xyz_W, voxel_size_m):
    while True:
        with contextlib.suppress(Exception):
            time.process_time()


def test_a_loop_without_end_is_left(monkeypatch):
    monkeypatch.setattr(learner_code, "LIMIT_S", 0.3)
    says("block_of", endless, "it ran for more than 0.3 s")


def test_recursion_without_end_is_the_students_error():
    def deeper(xyz_W, voxel_size_m):
        return deeper(xyz_W, voxel_size_m)

    says("block_of", deeper, "it raised RecursionError in line")
