"""What a notebook's text says about its own results, and whether it holds for the outputs that are
stored with it.

A text cell says what must hold in a comment that readers do not see:

    The passes gain more than a decibel.

    <!-- holds
    q17: held-out PSNR {before} -> {after} dB
    after - before > 1
    -->

A line that begins with the id of a code cell and a colon quotes a piece of what that cell shows.
``{name}`` stands for a number there and names it, ``{}`` for a number that is not needed; spaces do
not matter. The piece must be there exactly once. Every other line is a comparison of such numbers,
which must be true. It may use + - * / **, brackets, ``and``, ``or``, ``not``, ``abs``, ``min`` and
``max``.

``python tools/claims.py notebooks/*.ipynb`` lists what does not hold.
"""

import argparse
import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsfusion_nb.files import read_object

log = logging.getLogger(__name__)

_COMMENT = re.compile(r"<!--\s*holds\b(.*?)-->", re.DOTALL)
_QUOTE = re.compile(r"^([\w-]+):\s*(.+)$")
_BLANK = re.compile(r"\{(\w*)\}")
_NUMBER = r"[-+]?(?:\d[\d,]*\.?\d*|\.\d+)(?:e[-+]?\d+)?"

_FUNCTIONS: dict[str, Any] = {"__builtins__": {}, "abs": abs, "min": min, "max": max}


@dataclass(frozen=True)
class Claim:
    """One comment of a text cell: quotations (cell id, text), comparisons."""

    cell: str
    quotes: list[tuple[str, str]]
    comparisons: list[str]


def claims_of(notebook: dict[str, Any]) -> list[Claim]:
    """All claims of a notebook, as read from JSON.

    Raises:
        ValueError: a comment that compares nothing, because it would hold for any result.
    """
    claims = []
    for cell in notebook["cells"]:
        if cell["cell_type"] != "markdown":
            continue
        for comment in _COMMENT.findall(_text_of(cell["source"])):
            lines = [line.strip() for line in comment.splitlines() if line.strip()]
            quotes = [_QUOTE.match(line) for line in lines]
            comparisons = [line for line, quote in zip(lines, quotes, strict=True) if quote is None]
            if not comparisons:
                raise ValueError(f"cell {cell['id']} has a comment 'holds' that compares nothing")
            claims.append(
                Claim(
                    cell["id"],
                    [(q[1], q[2]) for q in quotes if q],
                    comparisons,
                )
            )
    return claims


def failures(notebook: dict[str, Any]) -> list[str]:
    """A sentence for everything that the text says and the stored outputs do not show; empty if all
    holds."""
    prints = shown_by(notebook)
    wrong = []
    for claim in claims_of(notebook):
        try:
            numbers: dict[str, float] = {}
            for cell_id, quote in claim.quotes:
                values = quoted(cell_id, quote, prints)
                numbers |= {name: float(text.replace(",", "")) for name, text in values.items()}
            wrong += [
                f"cell {claim.cell} says {text!r}, but {numbers}"
                for text in claim.comparisons
                if not evaluate(text, numbers)
            ]
        except ValueError as e:
            wrong.append(f"cell {claim.cell}: {e}")
    return wrong


def evaluate(text: str, numbers: dict[str, float]) -> bool:
    """Whether a comparison is true.

    Raises:
        ValueError: it is not a comparison of numbers, or uses a name that no quotation gave.
    """
    try:
        value = eval(text, _FUNCTIONS, numbers)
    except (SyntaxError, NameError, TypeError) as e:
        raise ValueError(f"{text!r}: {e}") from None
    if not isinstance(value, bool):
        raise ValueError(f"{text!r} compares nothing")
    return value


def shown_by(notebook: dict[str, Any]) -> dict[str, str]:
    """The text that each code cell shows, by the cell's id."""
    return {
        cell["id"]: _printed_text(cell) for cell in notebook["cells"] if cell["cell_type"] == "code"
    }


def quoted(
    cell_id: str,
    quote: str,
    prints: dict[str, str],
) -> dict[str, str]:
    """The numbers that a quotation names, as they are printed.

    Raises:
        ValueError: no such cell, or the text is not there exactly once.
    """
    if cell_id not in prints:
        raise ValueError(f"there is no code cell {cell_id!r}")
    names = []
    pattern = ""
    for i, part in enumerate(_BLANK.split(quote)):
        if i % 2:
            names.append(part)
            pattern += rf"({_NUMBER})"
        else:
            pattern += re.sub(r"(?:\\?\s)+", r"\\s*", re.escape(part))
    matches = list(re.finditer(pattern, prints[cell_id]))
    if len(matches) != 1:
        raise ValueError(
            f"{quote!r} is {len(matches)} times in what cell {cell_id} shows, once was expected"
        )
    pairs = zip(names, matches[0].groups(), strict=True)
    return {name: number for name, number in pairs if name}


def _printed_text(cell: dict[str, Any]) -> str:
    """The text that a code cell shows."""
    texts = []
    for output in cell.get("outputs", []):
        texts.append(_text_of(output.get("text", "")))
        texts.append(_text_of(output.get("data", {}).get("text/plain", "")))
    return "\n".join(texts)


def _text_of(text: str | list[str]) -> str:
    return text if isinstance(text, str) else "".join(text)


def main(arguments: list[str] | None = None) -> int:
    """The command line; 1 if something does not hold."""
    parser = argparse.ArgumentParser(
        description="Whether the text of notebooks holds for their stored outputs."
    )
    parser.add_argument("notebooks", type=Path, nargs="+")
    wrong = 0
    for path in parser.parse_args(arguments).notebooks:
        for sentence in failures(read_object(path, "a notebook")):
            log.error("%s: %s", path, sentence)
            wrong += 1
    return int(wrong > 0)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    raise SystemExit(main())
