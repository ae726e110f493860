"""The decks of slides: Markdown whose pictures and numbers come from the stored outputs of the
notebooks.

``python tools/slides.py SLIDES NOTEBOOKS OUT`` writes ``OUT/week_N.html`` with the program Marp,
which ``npx`` fetches once from the npm registry (``--marp`` names another command). In a deck

- ``![words](cell:02/057b416a)`` is the picture that cell ``057b416a`` of chapter 2 shows (the first
  one);
- ``{{02/057b416a: 4 x voxel {a}%}}`` is the number that stands for ``{a}`` in what the cell prints
  (the notation of ``tools/claims.py``), and ``{{docs/quality: ... {a} ...}}`` one of the page
  ``docs/quality.md``.

So a deck shows what the notebooks show, and building it fails if a cell or a number is gone.
"""

import argparse
import base64
import functools
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

from claims import quoted, shown_by

from gsfusion_nb.files import read_object, write_file

MARP = "npx --yes @marp-team/marp-cli@4"
_PICTURE = re.compile(r"\(cell:(\d\d)/([\w-]+)\)")
_NUMBER = re.compile(r"\{\{(\d\d|docs)/([\w-]+): (.+?)\}\}(?!\})")


class Chapters:
    """The stored outputs of the notebooks."""

    def __init__(self, folder: Path):
        self.folder = folder

    @functools.cache  # noqa: B019
    def notebook(self, chapter: str) -> dict[str, Any]:
        """The notebook whose name begins with two digits."""
        for path in self.folder.glob(f"{chapter}_*.ipynb"):
            return read_object(path, "a notebook")
        raise ValueError(f"there is no chapter {chapter} in {self.folder}")

    def picture(self, chapter: str, cell: str) -> tuple[str, bytes]:
        """Suffix and content of the first picture that a cell shows.

        Raises:
            ValueError: the cell shows none.
        """
        for each in self.notebook(chapter)["cells"]:
            for output in each.get("outputs", []) if each["id"] == cell else []:
                for kind, suffix in (("image/jpeg", ".jpg"), ("image/png", ".png")):
                    if kind in output.get("data", {}):
                        return suffix, base64.b64decode("".join(output["data"][kind]))
        raise ValueError(f"cell {cell} of chapter {chapter} shows no picture")

    def number(self, chapter: str, cell: str, quote: str) -> str:
        """The number that a quotation names, as the cell of a chapter has it.

        With ``docs`` as chapter: as the page ``cell`` has it, in the first of its sections with the
        words before the number.
        """
        if chapter == "docs":
            sections = (
                (self.folder.parent / "docs" / f"{cell}.md")
                .read_text(encoding="utf-8")
                .split("\n## ")
            )
            words = quote.partition("{")[0].strip()
            shown = {cell: next((section for section in sections if words in section), "")}
        else:
            shown = shown_by(self.notebook(chapter))
        found = [*quoted(cell, quote, shown).values()]
        if len(found) != 1:
            raise ValueError(f"{quote!r} must name one number")
        return found[0]


def prepare(deck: Path, chapters: Chapters, target: Path) -> Path:
    """Write the deck with its numbers, and its pictures beside it; returns the Markdown file in
    ``target``.

    Raises:
        ValueError: a cell, a picture or a number is not there.
    """

    def picture(match: re.Match[str]) -> str:
        suffix, content = chapters.picture(match[1], match[2])
        name = f"figures/{match[1]}_{match[2]}{suffix}"
        write_file(target / name, content)
        return f"({name})"

    text = _PICTURE.sub(picture, deck.read_text(encoding="utf-8"))
    text = _NUMBER.sub(
        lambda m: chapters.number(m[1], m[2], m[3]),
        text,
    )
    for name in re.findall(r"\(\.\./\.\./images/([\w.]+)\)", text):
        (target / "figures").mkdir(parents=True, exist_ok=True)
        shutil.copyfile(deck.parent / "../../images" / name, target / "figures" / name)
    text = text.replace("(../../images/", "(figures/")
    deck_copy = target / deck.name
    write_file(deck_copy, text)
    return deck_copy


def build(source: Path, notebooks: Path, target: Path, marp: str = MARP) -> None:
    """Build all decks of a folder as HTML.

    Raises:
        ValueError: what ``prepare`` raises.
        FileNotFoundError, subprocess.CalledProcessError: Marp is not there, or fails.
    """
    target.mkdir(parents=True, exist_ok=True)
    chapters = Chapters(notebooks)
    decks = [prepare(deck, chapters, target) for deck in sorted(source.glob("week_*.md"))]
    for name in ("theme.css", "marp.config.mjs"):
        shutil.copyfile(source / name, target / name)
    call = [
        *shlex.split(marp),
        "--config-file",
        "marp.config.mjs",
        "--allow-local-files",
        *(d.name for d in decks),
    ]
    subprocess.run(call, cwd=target, check=True, stdin=subprocess.DEVNULL)


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Build the slides of the course as HTML.")
    parser.add_argument("slides", type=Path, help="folder of the decks")
    parser.add_argument("notebooks", type=Path, help="folder of notebooks with their outputs")
    parser.add_argument("out", type=Path, help="folder for the HTML files")
    parser.add_argument("--marp", default=MARP, help="command that runs Marp")
    options = parser.parse_args(arguments)
    build(options.slides, options.notebooks, options.out, options.marp)


if __name__ == "__main__":
    main()
