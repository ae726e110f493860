"""Filling the marked places of the pages from the files of numbers."""

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from .recipes import COMMIT_HERE, ROOT, SAME_MAPS, read_numbers

MARKER = re.compile(
    r"(?<!`)<!-- (table|commands|text): ([\w-]+)(?: ([\w-]+))? -->(.*?)<!-- end -->", re.DOTALL
)


def filled(
    page: str,
    numbers: Callable[[str], Mapping[str, Any]],
) -> str:
    """The text of a page with every marked place made again; ``numbers`` gives the numbers of a
    name."""

    def place(match: re.Match[str]) -> str:
        kind, name, key, _ = match.groups()
        values = numbers(name)
        if kind == "text":
            return f"<!-- text: {name} {key} -->{values['texts'][key]}<!-- end -->"
        lines = ["```", *of_one_seed(values["commands"]), "```"]
        if kind == "table":
            rows = [
                values["columns"],
                ["---"] + ["---:"] * (len(values["columns"]) - 1),
                *values["rows"],
            ]
            lines = [re.sub(" +", " ", f"| {' | '.join(row)} |") for row in rows]
            lines += ["", origin(name, values)]
        return "\n".join([f"<!-- {kind}: {name} -->", *lines, "<!-- end -->"])

    return MARKER.sub(place, page)


def origin(name: str, numbers: Mapping[str, Any]) -> str:
    """The sentence under a table: when it was measured, and with which commit."""
    commit = numbers["commit"][:8]
    if numbers.get(COMMIT_HERE, True):
        text = f"Measured on {numbers['date']} with commit `{commit}`{with_threads(numbers)}."
        later = numbers.get(SAME_MAPS)
        return f"{text} Commit `{later['commit'][:8]}` makes the same maps." if later else text
    return (
        f"**These are not today's numbers.** They were measured on {numbers['date']} with commit "
        f"`{commit}`, which is "
        f'not in this repository. Measure again with `make measured RENEW="{name}"`.'
    )


def with_threads(numbers: Mapping[str, Any]) -> str:
    """Of a table with times: with how many threads; otherwise nothing."""
    if not numbers.get("quiet"):
        return ""
    threads = numbers["machine"]["threads"]
    return f", with {threads} threads" if threads > 1 else ", with one thread"


def of_one_seed(commands: Iterable[str]) -> list[str]:
    """Commands without those that differ from an earlier one by their seed alone."""
    first: dict[str, str] = {}
    for line in commands:
        first.setdefault(re.sub(r" --seed \d+", "", line), line)
    return list(first.values())


def pages(root: Path = ROOT) -> list[Path]:
    """README and all pages of the docs."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


def fill(root: Path = ROOT, *, write: bool) -> list[Path]:
    """Fill all pages from the files of numbers; returns those that differed."""
    stale = []
    for page in pages(root):
        text = page.read_text(encoding="utf-8")
        new = filled(text, lambda name: read_numbers(name, root))
        if new != text:
            stale.append(page)
            if write:
                page.write_text(new, encoding="utf-8")
    return stale
