"""A bank of multiple-choice questions, one for every wrong answer that a checker is tested with.

Most questions show the function and four statements about it. One of them is not true: the first property that fails.
The other three are true: the checker has tested them on the same function, and they hold. A property can hold on all
inputs of the checker and yet not be true of the function; those that a reader found are left out (``quiz_reading``).
Where the checker states too little, statements of that reader stand beside, or the question asks which number the
function returns. Either way there is one right option, and it is what the checker found.
"""

import random
import re
from dataclasses import dataclass
from pathlib import Path

from ...strict_json import read_object
from ..attempt import Failed
from ..exercise import Exercise, exercises
from .judged import Judged, judge_thoroughly
from .quiz_reading import ALSO_TRUE, COUNTED, NOT_OFFERED, NUMBERED
from .snippet import snippet

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


def bank(notebooks: Path) -> list[Question]:
    """All questions, in the order in which the notebooks ask for the functions."""
    tasks = tasks_of(notebooks)
    every = exercises()
    names = [name for name in tasks if name in every] + [name for name in every if name not in tasks]
    return [
        question(every[name], number, tasks.get(name, ""))
        for name in sorted(names, key=lambda name: every[name].chapter)
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
