"""Predictions: asked for before a cell runs, recorded, and shown beside what came.

In a notebook::

    # in a cell before
    predict("first_seeds", "How many Gaussians will the first frame give?", [300, 3000, 30000])

    # in a cell after
    came("first_seeds", report.n_seeds)

A click records the answer (``progress.py``); after ``came`` it stays. Where widgets do not work:
``predict("first_seeds", answer=3000)``.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..drawing.page import fill
from ..drawing.stored import Bundle, LiveOutput, static_views
from ..errors import ArgumentError
from .progress import Entries, forgiving, note, now, read_section

Answer = str | float | int

_SECTION = "predictions"
DECIBEL = "dB"
"""Unit of numbers of which the difference counts, not the ratio."""
_unkept: Entries = {}
"""Predictions of this process, for when the file cannot be read or written."""


class Prediction(LiveOutput):
    """A question with buttons, or with a field for a number. Notebooks show it; ``answer`` records
    from Python."""

    def __init__(
        self,
        name: str,
        question: str,
        choices: Sequence[Answer],
        unit: str,
    ):
        self.name = name
        self.question = question
        self.choices = list(choices)
        self.unit = unit

    def answer(self, value: Answer) -> str:
        """Record an answer and return a sentence about it.

        Raises:
            ValueError: not one of the choices; or not a number, where there are none.
        """
        entry = _entry(self.name)
        if "came" in entry:
            return f"It came already. {_yours(entry)}"
        if self.choices and value not in self.choices:
            raise ArgumentError(
                f"prediction {self.name}: expected one of {self.choices}, got {value!r}"
            )
        if not self.choices and (isinstance(value, str) or not math.isfinite(value)):
            raise ArgumentError(f"prediction {self.name}: expected a number, got {value!r}")
        _note(
            self.name,
            question=self.question,
            choices=self.choices,
            answer=value,
            unit=self.unit,
            when=now(),
        )
        return self.state

    @property
    def state(self) -> str:
        """What is recorded, in words."""
        entry = _entry(self.name)
        return _yours(entry) if "answer" in entry else "not predicted yet"

    def __repr__(self) -> str:
        options = (
            f" ({', '.join(_answer_words(c, self.unit) for c in self.choices)})"
            if self.choices
            else ""
        )
        return f"Predict: {self.question}{options}\n  {self.state}"

    def _repr_mimebundle_(self, **kwargs: Any) -> Bundle:
        html = fill(
            "prediction.html",
            prediction=self,
            options=[_answer_words(c, self.unit) for c in self.choices],
        )
        live = {} if static_views() else self._widget._repr_mimebundle_(**kwargs)
        return live | {"text/plain": repr(self), "text/html": html}, {}

    @functools.cached_property
    def _widget(self) -> Any:
        import ipywidgets as w

        label = w.HTML(self.state)
        answer = _entry(self.name).get("answer")
        style = {"description_width": "initial"}
        if self.choices:
            options = [(_answer_words(choice, self.unit), choice) for choice in self.choices]
            control = w.ToggleButtons(
                options=options, value=answer if answer in self.choices else None, style=style
            )
            control.style.button_width = "auto"
        else:
            start = answer if isinstance(answer, (int, float)) else None
            control = w.Text(
                value="" if start is None else f"{start:g}",
                placeholder="a number",
                description=self.unit,
                style=style,
                continuous_update=False,
                layout=w.Layout(width="220px"),
            )
        control.add_class("gsnb-prediction-answer")

        def record(change: Any) -> None:
            try:
                value = change["new"]
                label.value = self.answer(value if self.choices else float(value.replace(",", ".")))
                self.store_output()
            except ValueError:
                label.value = "Please give a number, such as 2.5."

        control.observe(record, names="value")
        box = w.VBox(
            [w.HTML(f"<b>Predict.</b> {fill('text.html', text=self.question)}"), control, label]
        )
        box.add_class("gsnb-prediction")
        return box


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What was predicted and what came."""

    predicted: str
    came: str
    right: bool | None
    """``None`` where nothing was predicted, or it is not one of two answers."""
    words: str = ""

    def __repr__(self) -> str:
        return f"{self.predicted} It came: {self.came}.{f' {self.words}' if self.words else ''}"

    def _repr_html_(self) -> str:
        colour = {True: "#1a7f37", False: "#b35900", None: "#6e7781"}[self.right]
        return fill("outcome.html", outcome=self, colour=colour)


def predict(
    name: str,
    question: str = "",
    choices: Sequence[Answer] = (),
    *,
    unit: str = "",
    answer: Answer | None = None,
) -> Prediction:
    """Ask for a prediction; the last line of a cell shows it.

    Args:
        name: Of the prediction; one for the whole course.
        question: One sentence.
        choices: Answers to choose from; none for a number.
        unit: Of numbers.
        answer: Records this answer, without a widget.
    """
    prediction = Prediction(
        name,
        question or str(_entry(name).get("question", name)),
        choices,
        unit,
    )
    if answer is not None:
        prediction.answer(answer)
    return prediction


def came(name: str, value: Any, *, right: Answer | None = None) -> Outcome:
    """What came, beside what was predicted. Of choices that are numbers the nearest one in ratio
    was right, in dB the one with the smallest difference.

    Args:
        name: Of the prediction.
        value: What came, a number (of any type with ``float()``) or a sentence without its full
            stop.
        right: The choice that was right, if that does not follow from ``value``.
    """
    value = value if isinstance(value, (str, int, float)) else float(value)
    entry = _entry(name)
    unit = str(entry.get("unit", ""))
    if "answer" in entry:
        _note(name, came=value)
    if entry.get("answer") is None:
        return Outcome(
            predicted="You made no prediction.", came=_answer_words(value, unit), right=None
        )
    verdict, words = _judgement(entry, value, right)
    return Outcome(
        predicted=_yours(entry),
        came=_answer_words(value, unit),
        right=verdict,
        words=words,
    )


def _judgement(
    entry: dict[str, Any], value: Answer, right: Answer | None
) -> tuple[bool | None, str]:
    """Whether the recorded answer was right, ``None`` if that cannot be told, and what is said
    about it."""
    answer = entry["answer"]
    unit = str(entry.get("unit", ""))
    if right is not None:
        is_right = answer == right
        return is_right, "" if is_right else f"Right was: {_answer_words(right, unit)}."
    if isinstance(answer, str) or isinstance(value, str):
        return None, ""
    compare = _compare_levels if unit == DECIBEL else _compare
    is_good, words = compare(float(answer), float(value))
    choices = [c for c in entry.get("choices", ()) if isinstance(c, (int, float))]
    nearest = _nearest_choice(choices, value, unit)
    return is_good if nearest is None else answer == nearest, words


def _nearest_choice(
    choices: Sequence[int | float], value: int | float, unit: str
) -> int | float | None:
    """The choice nearest to ``value``: in dB by the difference, else by the ratio, which only
    positive numbers have; ``None`` if there is none."""
    if unit == DECIBEL:
        return min(choices, key=lambda c: abs(c - value), default=None)
    positive = [c for c in choices if c > 0 and value > 0]
    return min(positive, key=lambda c: abs(math.log(c / value)), default=None)


def _compare(answer: float, value: float) -> tuple[bool, str]:
    """A prediction within a factor of two counts as good."""
    if answer * value <= 0:
        return answer == value, "" if answer == value else "That is another sign, or zero."
    times = value / answer
    if 0.8 < times < 1.25:
        return True, "Close."
    return 0.5 <= times <= 2, f"That is {times:.2g} times your number."


def _compare_levels(answer: float, value: float) -> tuple[bool, str]:
    """Decibels are logarithms already, so their difference counts: up to 3 dB is good, a factor of
    two in the mean squared error."""
    difference = value - answer
    if abs(difference) < 1:
        return True, "Close."
    direction = "more" if difference > 0 else "less"
    return abs(difference) <= 3, f"That is {abs(difference):.2g} dB {direction} than your number."


def _yours(entry: dict[str, Any]) -> str:
    return (
        f"You predicted {_answer_words(entry['answer'], str(entry.get('unit', '')))}."
        if "answer" in entry
        else ""
    )


def _answer_words(value: Answer, unit: str) -> str:
    if isinstance(value, str):
        return value
    number = f"{value:,}" if isinstance(value, int) else f"{value:,.4g}"
    return f"{number} {unit}".strip()


def _entry(name: str) -> dict[str, Any]:
    entry = dict(_unkept.get(name, {}))
    with forgiving():
        entry |= read_section(_SECTION).get(name, {})
    return entry


def _note(name: str, **values: Any) -> None:
    _unkept.setdefault(name, {}).update(values)
    with forgiving():
        note(_SECTION, name, **values)
