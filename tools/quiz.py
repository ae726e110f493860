"""A bank of multiple-choice questions, one for every wrong answer that a checker is tested with.

Most questions show the function and four statements about it. One of them is not true: the first property that fails.
The other three are true: the checker has tested them on the same function, and they hold. A property can hold on all
inputs of the checker and yet not be true of the function; those that a reader found are left out
(``NOT_OFFERED``).
Where the checker states too little, statements of that reader stand beside, or the question asks which number the
function returns. Either way there is one right option, and it is what the checker found.
"""

import ast
import inspect
import io
import random
import re
import textwrap
import tokenize
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsfusion_nb.course.attempt import Attempt, Failed, NotWritten
from gsfusion_nb.course.exercise import Exercise, exercises
from gsfusion_nb.course.learner_code import plain_value
from gsfusion_nb.files import read_object
from gsfusion_nb.types import Camera

_PURE = (torch.Tensor, np.ndarray, Camera, int, float, list, dict)
"""Arguments that a second call finds as the first one did."""
_STATEMENTS = ("close", "holds")
"""With these a judge states a property. What fails in another way ends the judgement."""


@dataclass
class Judged:
    """What a judge found in one function."""

    broken: list[Failed] = field(default_factory=list)
    """Properties that failed, the first one first."""
    held: list[str] = field(default_factory=list)
    """Properties that were tested and never failed."""
    right_on: list[str] = field(default_factory=list)
    """Inputs, in words, for which it returns what the solution returns."""


def judge_thoroughly(exercise: Exercise, function: Callable[..., Any]) -> Judged:
    """Run the judge of an exercise on a function to its end, or to an error from which it cannot go on.

    Raises:
        ValueError: no property fails, so the function is no wrong answer.
    """
    found = Judged()
    attempt = _Compared(function, exercise._solution)
    with _collecting(inspect.unwrap(exercise.judge).__globals__, found):
        try:
            exercise.judge(attempt)
        except Failed as e:
            found.broken.append(e)
        except NotWritten:
            raise ValueError(f"{exercise.name}: the function is not written") from None
        except Exception:
            if not found.broken:
                raise
    if not found.broken:
        raise ValueError(f"{exercise.name}: {function.__name__} passes, so it is no wrong answer")
    props = {e.prop for e in found.broken}
    found.held = [prop for prop in dict.fromkeys(found.held) if prop not in props]
    wrong_on = {e.on for e in found.broken}
    found.right_on = [on for on, right in attempt.right.items() if right and on not in wrong_on]
    return found


class _Compared(Attempt):
    """An attempt that also notes for which inputs the solution returns the same."""

    def __init__(self, function: Callable[..., Any], solution: Callable[..., Any]):
        super().__init__(function)
        self.solution = solution
        self.right: dict[str, bool] = {}
        """Input, in words -> whether all calls with it returned what the solution returns."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        on = self.words
        returned = super().__call__(*args, **kwargs)
        pure = all(isinstance(a, _PURE) for a in (*args, *kwargs.values()))
        same = pure and _same(returned, Attempt(self.solution)(*args, **kwargs))
        self.right[on] = same and self.right.get(on, True)
        return returned


def _same(got: Any, expected: Any) -> bool:
    """Whether two answers are equal, to a rounding."""
    got, expected = plain_value(got), plain_value(expected)
    if isinstance(expected, (list, tuple)):
        return (
            isinstance(got, (list, tuple))
            and len(got) == len(expected)
            and all(_same(a, b) for a, b in zip(got, expected, strict=True))
        )
    if isinstance(expected, torch.Tensor | int | float) and isinstance(got, torch.Tensor | int | float):
        a, b = (torch.as_tensor(value).detach().double() for value in (got, expected))
        return a.shape == b.shape and torch.allclose(a, b, rtol=1e-5, atol=1e-7, equal_nan=True)
    return type(got) is type(expected) and got == expected


@contextmanager
def _collecting(module: dict[str, Any], found: Judged) -> Iterator[None]:
    """Within the block, the statements of a chapter's judges note a failure and go on."""

    def noting(statement: Callable[..., None]) -> Callable[..., None]:
        def noted(*args: Any, **kwargs: Any) -> None:
            prop = kwargs.get("prop", args[{"close": 2, "holds": 1}[statement.__name__]])
            try:
                statement(*args, **kwargs)
            except Failed as e:
                found.broken.append(e)
            else:
                found.held.append(prop)

        return noted

    original = {name: module[name] for name in _STATEMENTS if name in module}
    module.update({name: noting(statement) for name, statement in original.items()})
    try:
        yield
    finally:
        module.update(original)


NOT_OFFERED: dict[str, tuple[str, ...]] = {
    "psnr-1": ("the differences are squared before they are averaged",),
    "psnr-3": ("it is a mean over all values, not a sum",),
    "project_points-4": ("a point twice as far lands half as far from the principal point",),
    "tiles_touched-3": ("a splat inside one tile is in that tile", "a splat across a border is on both sides"),
    "composite_pixel-1": ("what is behind gets only the light that is left",),
    "composite_pixel-2": ("what is behind gets only the light that is left", "nothing is in front of the first one"),
    "splat_alpha-2": ("alpha = opacity exp(-sigma)",),
    "project_gaussian-1": ("straight ahead is the principal point",),
    "splat_alpha_vjp-3": ("v_uv = alpha v_alpha (A dx + B dy, B dx + C dy)", "v_opacity = v_alpha exp(-sigma)"),
    "splat_alpha_vjp-4": (
        "v_uv agrees with autograd", "v_conic agrees with autograd", "v_opacity agrees with autograd",
        "v_opacity = v_alpha exp(-sigma)", "v_uv = alpha v_alpha (A dx + B dy, B dx + C dy)",
    ),
    "map_frame-1": ("the new Gaussians are in the map when the frame is optimised",),
    "disc_hit-4": ("beyond 60 degrees the depth of the centre is used",),
    "fuse-1": ("a Gaussian never seen does not change",),
    "fuse-2": ("a Gaussian never seen does not change",),
    "silhouette_rule-3": ("where the map is opaque already, nothing is seeded",),
    "pose_shift-2": ("shifts of up to reach frames are tried",),
    "tell_apart-1": (
        "what counts as small is a multiple of noise_m, for the given pose and for the best one",
        "the best motion may also turn",
    ),
}  # fmt: skip
"""Properties that hold on the inputs of the checker and are not true of the function, or so near the right option that
both could be meant."""

ALSO_TRUE: dict[str, tuple[str, ...]] = {
    "exam_frames-3": ("it names no frame twice", "a frame that it names is one of the n frames"),
    "first_seen-1": (
        "a cell without depth gets no Gaussian", "a voxel that was seen before gets no Gaussian",
        "the two conditions must both hold",
    ),
    "psnr-1": ("a picture that is twice as far off everywhere has a lower PSNR",),
    "block_of-2": (
        "the point (0, 0, 0) is in block (0, 0, 0)", "a block has 8 voxels along each axis", "it returns whole numbers",
    ),
    "slope-1": (
        "it calls the loss once more than x has elements", "a smaller h gives a smaller error, until rounding counts",
    ),
    "fuse-1": (
        "where before and after are equal, it returns them", "every row has its own weight",
        "the weights of before and after add up to 1",
    ),
    "fuse-2": (
        "where before and after are equal, it returns them", "it does not use the numbers of steps",
        "the weights of before and after add up to 1",
    ),
    "disc_hit-4": ("the length of the ray does not matter", "a normal may point either way"),
    "silhouette_rule-3": (
        "a cell without depth gets no Gaussian", "it compares the opacity that it reads with max_alpha",
    ),
    "morton_code-1": ("the code of (0, 0, 0) is 0", "two different blocks have different codes"),
    "zero_crossing-3": ("where D0 = 0 it returns p0", "where D1 = 0 it returns p1", "it returns a point for each edge"),
    "split_cell-2": ("it returns four parts", "the four parts have the right sizes"),
    "covariance_2d-2": (
        "fx acts on u and fy on v", "a Gaussian of twice the size gives a matrix four times as large",
        "off the axis, extent along z widens the ellipse",
    ),
    "slope-3": (
        "it calls the loss twice for each element", "the slope of a straight line is its coefficients",
        "it divides by the distance between the two points at which it calls the loss",
    ),
    "splat_alpha_vjp-3": ("for a single pixel it is right",),
    "splat_alpha_vjp-4": ("where alpha is neither capped nor cut, it is right",),
    "map_frame-1": ("it returns the number of new Gaussians", "no frame becomes a keyframe"),
    "raster_rule-1": (
        "all seeds of the right rule are among its seeds", "it makes one seed more than the right rule",
        "one of its seeds is at the origin of the world",
    ),
    "raster_rule-4": (
        "without an option it takes squares of 8 pixels", "its seeds are where those of the right rule are",
        "it makes as many seeds as the right rule",
    ),
    "adam_traffic-2": (
        "it counts four arrays that are read and three that are written", "the intensity does not depend on the size",
        "twice the numbers give twice the first result",
    ),
    "average_loop-2": (
        "the weight stops at max_weight", "d counts as at most 1", "a voxel without depth does not change",
    ),
}  # fmt: skip
"""Statements that are true of the function as it stands in the question."""

NUMBERED = frozenset({
    "halve_intrinsics-1", "halve_intrinsics-2", "block_of-3", "view_colour-1", "slope-2", "inverse_vjp-1",
    "inverse_vjp-2", "pinhole_vjp-1", "raster_rule-2", "silhouette_rule-1", "attainable_gflops-2",
    "attainable_gflops-3", "adam_traffic-1", "depth_factor-1",
})  # fmt: skip
"""Questions that ask for the number which comes back: the words for the input say all that is needed to find it."""

COUNTED = {"raster_rule": "seeds", "silhouette_rule": "seeds"}
"""Exercises whose judge counts what comes back."""


def snippet(exercise: Exercise, function: Callable[..., Any]) -> str:
    """Source code of a wrong answer; a call of the course's solution becomes ``correct_<exercise>``."""
    parts = [_plain_source(function)]
    seen = {function, exercise._solution}
    constants: dict[str, Any] = {}
    queue = [function]
    while queue:
        for name, value in _globals_of(queue.pop()):
            if isinstance(value, int | float) and not isinstance(value, bool):
                constants[name] = value
            elif inspect.isfunction(value) and name.startswith("_") and value not in seen:
                seen.add(value)
                parts.insert(0, _plain_source(value))
                queue.append(value)
    if constants:
        parts.insert(0, "\n".join(f"{name} = {value:.5g}" for name, value in sorted(constants.items())))
    code = "\n\n".join(parts)
    code = re.sub(rf"\b{re.escape(exercise._solution.__name__)}\b", f"correct_{exercise.name}", code)
    return re.sub(rf"\b{re.escape(function.__name__)}\b", exercise.name, code)


def _globals_of(function: Callable[..., Any]) -> Iterator[tuple[str, Any]]:
    """Names of the function's own module that its code uses, also in its inner functions."""
    module = getattr(inspect.unwrap(function), "__globals__", {})
    codes = [inspect.unwrap(function).__code__]
    while codes:
        code = codes.pop()
        codes += [c for c in code.co_consts if inspect.iscode(c)]
        for name in sorted(code.co_names):
            value = module.get(name)
            if not inspect.isfunction(value) or value.__module__ == function.__module__:
                yield name, value


def _plain_source(function: Callable[..., Any]) -> str:
    """Source code without docstring and comments."""
    source = textwrap.dedent(inspect.getsource(function))
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column].rstrip()
    definition = ast.parse(source).body[0]
    assert isinstance(definition, ast.FunctionDef)
    first = definition.body[0]
    if ast.get_docstring(definition) is not None and len(definition.body) > 1:
        del lines[first.lineno - 1 : first.end_lineno]
    return "\n".join(line for line in lines if line.strip())


_ALWAYS = (
    "it runs without an error on the checker's inputs",
    "it does not change its inputs",
    "it can be called with the arguments that the exercise names",
)
"""True of every wrong answer that is not refused for just this."""
_REFUSED_FOR = {
    "it runs": _ALWAYS[0],
    "it does not change its inputs": _ALWAYS[1],
}


_STATEMENT = "Which of these statements is **not** true of this function?"
_NUMBER = re.compile(r"^got (\S+?)( (?:at \[[\d, ]+\]|for \w+))?, expected (\S+?)(?:[.:] |$)")


@dataclass(frozen=True, kw_only=True)
class Question:
    """One question, and what to say after the answer."""

    name: str
    """Exercise and number of the wrong answer, counted from 1."""
    chapter: int
    exercise: str
    title: str
    """What the exercise asks for."""
    task: str
    """The first lines of the function in the notebook: what goes in and out."""
    code: str
    prompt: str
    options: tuple[str, ...]
    answer: int
    """Position of the right option."""
    prop: str
    """The property that fails."""
    on: str
    """The input on which it fails."""
    detail: str
    """What came back, and what was expected."""


def bank(notebooks: Path, chapters: Collection[int] | None = None) -> list[Question]:
    """All questions, or those of some chapters, in the order in which the notebooks ask for the functions."""
    tasks = tasks_of(notebooks)
    every = exercises()
    names = [name for name in tasks if name in every] + [name for name in every if name not in tasks]
    return [
        question(every[name], number, tasks.get(name, ""))
        for name in sorted(names, key=lambda name: every[name].chapter)
        if chapters is None or every[name].chapter in chapters
        for number in range(1, len(every[name].wrong) + 1)
    ]


def question(exercise: Exercise, number: int, task: str) -> Question:
    """The question about wrong answer ``number`` of an exercise."""
    function = exercise.wrong[number - 1].function
    judged = judge_thoroughly(exercise, function)
    first = judged.broken[0]
    name = f"{exercise.name}-{number}"
    prompt, right, others = _STATEMENT, first.prop, _true_statements(judged, name)
    if name in NUMBERED:
        prompt, right, others = _about_a_number(first, COUNTED.get(exercise.name, ""))
    options = [right, *others]
    random.Random(name).shuffle(options)
    return Question(
        name=name, chapter=exercise.chapter, exercise=exercise.name, title=exercise.title, task=task,
        code=snippet(exercise, function), prompt=prompt, options=tuple(options), answer=options.index(right),
        prop=first.prop, on=first.on, detail=first.detail,
    )  # fmt: skip


def _true_statements(judged: Judged, name: str) -> list[str]:
    """Three statements that hold: the checker's own, a reader's, inputs on which it is right, what always holds."""
    refused = {_REFUSED_FOR[e.prop] for e in judged.broken if e.prop in _REFUSED_FOR}
    own = [prop for prop in judged.held if prop not in NOT_OFFERED.get(name, ())]
    random.Random(name).shuffle(own)
    inputs = (on for on in judged.right_on if not on.startswith("the same"))  # "the same" as what, out of its place?
    right = [f"its result is right for this input: {on}" for on in inputs]
    return [*own, *ALSO_TRUE.get(name, ()), *right, *(s for s in _ALWAYS if s not in refused)][:3]


def _about_a_number(failed: Failed, counted: str) -> tuple[str, str, list[str]]:
    """Prompt, right option and three others about the number that came back.

    What a right function returns is among the others, for those who do not see the mistake.
    """
    match = _NUMBER.match(failed.detail)
    assert match is not None, f"this is no question about a number: {failed.detail}"
    place, value, right = match[2] or "", float(match[1]), float(match[3])
    near = [right, 2 * value, value / 2, value - right, value + right, 2 * right, right / 2]
    if counted:
        near = [n for n in near if n >= 0]
    if value.is_integer() and right.is_integer():
        near = [n for n in near if n.is_integer()]
    others = [text for text in dict.fromkeys(f"{n + 0.0:.5g}" for n in near) if text != f"{value:.5g}"][:3]
    what = f"How many {counted} does" if counted else "What does"
    prompt = f"Input: {failed.on}. {what} this function return{place}?"
    return prompt, f"{value:.5g}", others


def tasks_of(notebooks: Path) -> dict[str, str]:
    """The docstring of every unwritten function of the notebooks, by the function's name, in their order."""
    pattern = re.compile(r'^def (\w+)\(.*?\).*?:\n    """(.*?)"""', re.DOTALL | re.MULTILINE)
    found = {}
    for path in sorted(notebooks.glob("*.ipynb")):
        for cell in read_object(path, "a notebook")["cells"]:
            source = "".join(cell["source"])
            if cell["cell_type"] == "code" and source.rstrip().endswith("..."):
                found |= {name: _one_line(words) for name, words in pattern.findall(source)}
    return found


def _one_line(words: str) -> str:
    return re.sub(r"\s+", " ", words).strip()
