"""The registered seeding rules as a table to choose from."""

import re
from typing import Any

from markupsafe import Markup

from ...drawing.page import html_table
from ...seeding import registered, rule_options


class RuleTable:
    """Name, first sentence and options of each registered rule. Made by ``rule_table``."""

    def __init__(self, rows: list[tuple[str, str, dict[str, Any]]]):
        self.rows = rows

    def __repr__(self) -> str:
        return "\n".join(
            f"{name}\n    {sentence}\n    {_in_words(options)}"
            for name, sentence, options in self.rows
        )

    def _repr_html_(self) -> str:
        code = Markup("<code>{}</code>")
        words = Markup("{}<br><small>{}</small>")  # below each other: two columns fit a phone
        rows = [
            (code.format(name), words.format(sentence, _in_words(options)))
            for name, sentence, options in self.rows
        ]
        return html_table(
            rows,
            heads=("rule", "what it does; its options and their defaults"),
            style="font-size:12px",
            cell_style="text-align:left;vertical-align:top",
        )


def rule_table() -> RuleTable:
    """The registered seeding rules, to choose one for ``rule_panel`` or a comparison."""
    return RuleTable(
        [
            (name, _first_sentence(rule.__doc__ or ""), rule_options(name))
            for name, rule in registered().items()
        ]
    )


def _first_sentence(text: str) -> str:
    paragraph = " ".join(text.strip().partition("\n\n")[0].split()).replace("``", "")
    return re.split(r"(?<=\.)\s+(?=[A-Z])", paragraph, maxsplit=1)[0]


def _in_words(options: dict[str, Any]) -> str:
    return ", ".join(f"{name} {_value_in_words(value)}" for name, value in options.items())


def _value_in_words(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)
