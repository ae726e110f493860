"""The verdict on a function of a submission: its exercise's judge, then hidden inputs from the seed of the class."""

import functools
import logging
import math
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...backends import use_backend
from ..attempt import Attempt, Verdict, as_rows, close, holds, watching_properties
from ..exercise import Exercise, exercises
from ..seeding_scene import wall_context
from .draws import DRAWS, whole
from .sandbox import Limits, Sandbox, unprotected
from .sandbox_program import Cell

log = logging.getLogger(__name__)

HIDDEN = "it is right for inputs that the notebook does not show, too"
_ON = "one that the notebook does not show"
_WHY = "The checks of the notebook pass: look for a special case, or for a number that should be an argument"
_CALLS = 5
"""Hidden inputs of an exercise."""
_CELLS = ("quadtree_leaves",)
"""Exercises that return cells, in any order."""


def verdicts(cells: Mapping[str, Sequence[Cell]], seed: int, limits: Limits) -> dict[str, Verdict]:
    """The verdicts on the functions of one submission, in the sandbox.

    Args:
        cells: Exercise, in the order of the course -> the code cells that define its function.
        seed: Of the hidden inputs.
        limits: Of each function.

    Raises:
        NoSandbox: this system cannot run submissions.
    """
    found: dict[str, Verdict] = {}
    with Sandbox(limits) as sandbox:
        for name, own in cells.items():
            accepted = frozenset(n for n, verdict in found.items() if verdict)
            found[name] = verdict_on(exercises()[name], sandbox.function(name, own, accepted), seed)
    return found


@functools.cache
def warn() -> None:
    """Say once what is not guarded here."""
    if unprotected():
        log.warning(unprotected())


def hidden_test(name: str, function: Any, history: Sequence[str], *, seed: int) -> bool:
    """Judge ``name`` as it was written in the cells run so far, in a process of its own.

    A test of an exported notebook; the plug-ins of nbgrader and Otter mark without running the notebook.

    Args:
        name: Exercise.
        function: The student's; it must exist, and is not called here.
        history: ``In`` of the notebook.
        seed: Of the hidden inputs.

    Raises:
        AssertionError: a property does not hold.
    """
    warn()
    cells = [Cell(f"cell [{i}]", source) for i, source in enumerate(history)]
    verdict = verdicts({name: cells}, seed, Limits())[name]
    if not verdict:
        raise AssertionError(sentence(verdict))
    return True


def sentence(verdict: Verdict) -> str:
    """What a student reads about an answer that is not right."""
    prop, message = why(verdict)
    return f"not true yet: “{prop}”; {message}"


def why(verdict: Verdict) -> tuple[str, str]:
    """The property that failed, and what was returned and expected."""
    if verdict.state == "not written":
        return "it is written", f"{verdict.detail}: write its body, with a return at the end"
    return verdict.prop, f"input: {verdict.on}; {verdict.detail}" if verdict.on else verdict.detail


def verdict_on(exercise: Exercise, function: Any, seed: int) -> Verdict:
    """The verdict of the exercise's judge and, if that is good, on hidden inputs. Nothing is kept or noted."""

    def judge(attempt: Attempt) -> None:
        exercise.judge(attempt)
        judge_hidden(exercise, attempt, seed)

    state = torch.get_rng_state()
    try:
        with use_backend("reference"):
            return exercise.verdict_on(Attempt(function), judge)
    finally:
        torch.set_rng_state(state)


def judge_hidden(exercise: Exercise, attempt: Attempt, seed: int) -> None:
    """Compare with the reference on inputs that the seed draws; an exercise in which answers may differ has its own.

    Raises:
        Failed: they differ.
    """
    generator = torch.Generator().manual_seed(zlib.crc32(f"{seed} {exercise.name}".encode()))
    if exercise.name in _OWN:
        _OWN[exercise.name](exercise, attempt, generator)
        return
    draw = DRAWS.get(exercise.name)
    for _ in range(_CALLS if draw else 0):
        args = draw(generator)  # pyright: ignore[reportOptionalCall]
        expected = exercise._solution(*_copies(args))
        got = attempt.on(_ON)(*args)
        _agrees(got, expected, HIDDEN, cells=exercise.name in _CELLS)


def properties(exercise: Exercise) -> list[str]:
    """What the judge of an exercise asks, in its order, as found by judging the solution."""
    with watching_properties() as seen, use_backend("reference"):
        exercise.judge(Attempt(exercise._solution))
    return list(dict.fromkeys([*seen, HIDDEN]))


def _copies(args: tuple[Any, ...]) -> list[Any]:
    return [a.clone() if isinstance(a, Tensor) else a.copy() if isinstance(a, np.ndarray) else a for a in args]


def _agrees(got: Any, expected: Any, prop: str, *, cells: bool = False) -> None:
    on = _ON
    if cells:
        got, expected = ({tuple(map(int, cell)) for cell in as_rows(value)} for value in (got, expected))
        holds(got == expected, prop, on=on, detail=f"it returned {len(got)} cells, expected {len(expected)}")
    elif isinstance(expected, str):
        holds(got == expected, prop, on=on, detail=f"got {got!r}, expected {expected!r}")
    elif isinstance(expected, tuple) and not all(isinstance(part, (int, float)) for part in expected):
        holds(
            isinstance(got, (tuple, list)) and len(got) == len(expected),
            prop,
            on=on,
            detail=f"expected {len(expected)} results",
        )
        for mine, right in zip(got, expected, strict=True):
            close(mine, right, prop, on=on, tolerance=1e-4, why=_WHY)
    else:
        close(got, expected, prop, on=on, tolerance=1e-4, why=_WHY)


def _draw_keyframes(exercise: Exercise, attempt: Attempt, g: torch.Generator) -> None:
    for _ in range(_CALLS):
        n, count = whole(g, 1, 12), whole(g, 1, 12)
        got = torch.as_tensor(attempt.on(_ON)(n, count, g)).reshape(-1).tolist()
        right = len(got) == len(set(got)) == min(n, count) and all(0 <= i < n for i in got)
        holds(right, HIDDEN, on=_ON, detail=f"{count} out of {n}: got {got}")


def _budget_cells(exercise: Exercise, attempt: Attempt, g: torch.Generator) -> None:
    for _ in range(2):
        image = torch.randint(0, 256, (whole(g, 12, 24), whole(g, 12, 24), 3), generator=g, dtype=torch.uint8)
        image[:, : whole(g, 3, 8)] //= 32
        n = whole(g, 10, 40)
        scores = []
        for cells in (attempt.on("a hidden image")(image, n), exercise._solution(image.clone(), n)):
            rows = [tuple(map(int, cell)) for cell in as_rows(cells)]
            covered = torch.zeros(image.shape[:2], dtype=torch.int64)
            for x, y, w, h in rows:
                covered[y : y + h, x : x + w] += 1
            whole_image = bool((covered == 1).all()) and len(rows) <= n
            parts = [image[y : y + h, x : x + w].double().flatten(0, 1) for x, y, w, h in rows if w > 0 and h > 0]
            error = sum(float(((p - p.mean(0)) ** 2).sum()) for p in parts)
            scores.append(error if whole_image else math.inf)
        detail = f"{n} cells: a squared error of {scores[0]:.4g} is left, the reference's {scores[1]:.4g}"
        holds(scores[0] <= 1.02 * scores[1] + 1e-6, HIDDEN, on="a hidden image", detail=detail)


def _rule(exercise: Exercise, attempt: Attempt, g: torch.Generator) -> None:
    raster = exercise.name == "raster_rule"
    for _ in range(2):
        option: dict[str, Any] = {"step_px": whole(g, 5, 13)} if raster else {"max_alpha": whole(g, 20, 80) / 100}
        ctx = wall_context(covered="nothing" if raster else "quarter")
        on = f"a wall, {next(iter(option))} = {next(iter(option.values()))}"
        got, expected = _rows(attempt.on(on)(ctx, **option)), _rows(exercise._solution(ctx, **option))
        holds(len(got) == len(expected), HIDDEN, on=on, detail=f"{len(got)} seeds, expected {len(expected)}")
        close(got, expected, HIDDEN, on=on, tolerance=1e-4)


def _rows(seeds: Any) -> Tensor:
    """Position and size of seeds, in one order."""
    rows = torch.cat([seeds.xyz_W, seeds.scale_m], dim=1).double()
    return torch.tensor(sorted((rows * 1e5).round().tolist()), dtype=torch.float64).reshape(-1, 6) / 1e5


def _map_frame(exercise: Exercise, attempt: Attempt, g: torch.Generator) -> None:
    """Its judge compares whole mappers; what is left to hide are the numbers of the settings."""


_OWN = {
    "draw_keyframes": _draw_keyframes, "budget_cells": _budget_cells, "raster_rule": _rule, "silhouette_rule": _rule,
    "map_frame": _map_frame,
}  # fmt: skip
