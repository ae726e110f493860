"""Questions and hints of a notebook in a page, which answer without Python."""

import ast
import re
from html import escape
from typing import Any

from gsfusion_nb.course.exercise import exercises

_EMPTY = re.compile(r"^def (\w+)\(", re.MULTILINE)


def call_text(call: ast.Call) -> str:
    return call.func.id if isinstance(call.func, ast.Name) else getattr(call.func, "attr", "")


def last_call(source: str) -> ast.Call | None:
    """The call that the last line of a cell is, if it is one."""
    try:
        body = ast.parse(source).body
    except SyntaxError:
        return None
    last = body[-1] if body else None
    return last.value if isinstance(last, ast.Expr) and isinstance(last.value, ast.Call) else None


def right_choice(call: ast.Call) -> str:
    """The right choice where the cell names it."""
    right_values = [k.value for k in call.keywords if k.arg == "right"]
    return (
        escape(str(ast.literal_eval(right_values[0])))
        if right_values and isinstance(right_values[0], ast.Constant)
        else ""
    )


def question_html(call: ast.Call) -> str:
    """The form of a call of ``predict``; ``book.js`` shows what came after an answer."""
    values = dict(
        zip(
            ("name", "question", "choices"),
            map(ast.literal_eval, call.args),
            strict=False,
        )
    )
    values |= {k.arg: ast.literal_eval(k.value) for k in call.keywords}
    name = escape(values["name"])
    unit = values.get("unit", "")

    def words(choice: Any) -> str:
        number = (
            f"{choice:,}"
            if isinstance(choice, int)
            else f"{choice:,.4g}"
            if isinstance(choice, float)
            else ""
        )
        return escape(f"{number} {unit}".strip() if number else choice)

    inputs = [
        f'<label><input type="radio" name="{name}" value="{escape(str(choice))}"> '
        f"{words(choice)}</label>"
        for choice in values.get("choices", ())
    ] or [
        f'<label>your number, {escape(unit) or "any"}: <input type="number" step="any" '
        f'name="{name}"></label>'
    ]
    return (
        f'<form class="gsnb-question" data-prediction="{name}"><fieldset><legend><b>Predict.</b> '
        f'{escape(values["question"])}</legend><div class="gsnb-choices">{"".join(inputs)}</div>'
        '<button type="submit">See what came</button> <button type="button" class="gsnb-skip">Show '
        "without a "
        'prediction</button></fieldset><p role="status"></p></form>'
    )


def hints_html(source: str) -> str:
    """The hints of the functions that a cell leaves unwritten, to unfold one by one."""
    if not source.endswith("..."):
        return ""
    every = exercises()
    hints_html = ""
    for name in _EMPTY.findall(source):
        for number, hint in reversed(
            list(enumerate(every[name].hints if name in every else (), 1))
        ):
            next_hints = hints_html if number < len(every[name].hints) else ""
            of = f"Hint {number} of {len(every[name].hints)}"
            hints_html = (
                "<details "
                f'class="gsnb-hint"><summary>{of}</summary><p>{escape(hint)}</p>{next_hints}</details>'
            )
    return hints_html
