"""``gsfusion-nb course DIR``: the notebooks to work in; without a folder: how far you are.

``gsfusion-nb course export``: assignments.
"""

import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..errors import ArgumentError
from .options import parse_options


@dataclass(frozen=True, kw_only=True)
class CourseOptions:
    """Copy the notebooks of the course into a folder, or show how far you are in them.

    For lecturers: gsfusion-nb course export --help.
    """

    folder: Annotated[Path | None, tyro.conf.Positional] = None
    """Where to write the notebooks, without solutions, and the documentation that they link to. A
    notebook that is there already stays; to get its newest edition, rename yours."""
    path: Literal["whole", "short"] = "whole"
    """whole: all chapters, about 27 hours. short: one notebook of two hours, from one frame to a
    seeding rule."""
    open: bool = False
    """Then open the first one in JupyterLab."""
    for_class: bool = False
    """Without outputs, to hand out; a notebook that is there already is replaced."""

    reset: bool = False
    """Start the course again, also together with a folder. The file with your progress is renamed,
    not deleted."""


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Write the solved chapters as assignments for nbgrader: points, solution cells, tests."""

    out: Path
    """The course folder of nbgrader generate_assignment. Nothing in it is replaced."""
    chapters: Annotated[tuple[int, ...], tyro.conf.Positional] = ()
    """Numbers of chapters. Default: all."""
    notebooks: Path | None = None
    """Folder of the solved chapters. Default: those of the program."""


def export(arguments: list[str]) -> int:
    """The command ``gsfusion-nb course export``."""
    from ..course.copies import notebooks_folder
    from ..course.grading.export import export_course

    options = parse_options(ExportOptions, prog="gsfusion-nb course export", arguments=arguments)
    folder = options.notebooks or notebooks_folder()
    notebooks = sorted(folder.glob("[0-9][0-9]_*.ipynb"))
    chapters = [p for p in notebooks if not options.chapters or int(p.name[:2]) in options.chapters]
    missing = set(options.chapters) - {int(p.name[:2]) for p in chapters}
    if missing or not chapters:
        raise ArgumentError(f"there is no chapter {min(missing) if missing else ''} in {folder}")
    for path in export_course(chapters, options.out):
        print(f"wrote {path}")
    return 0


def run(arguments: list[str]) -> int:
    """The command."""
    if arguments[:1] == ["export"]:
        return export(arguments[1:])
    from ..course.course import read_course
    from ..course.progress import reset

    options = parse_options(CourseOptions, prog="gsfusion-nb course", arguments=arguments)
    if options.folder is None:
        unused_options = [
            f"--{name.replace('_', '-')}"
            for name in ("path", "open", "for_class")
            if _is_set(options, name)
        ]
        if unused_options:
            raise ArgumentError(
                f"{' and '.join(unused_options)} needs the folder of the notebooks: "
                "gsfusion-nb course FOLDER"
            )
    if options.reset:
        old_progress = reset()
        print(
            f"The course starts again. Your progress so far is kept in {old_progress}"
            if old_progress
            else "There was no progress."
        )
    if options.folder is not None:
        return _copy(options.folder, options)
    if not options.reset:
        print(read_course().as_table())
    return 0


def _is_set(options: CourseOptions, name: str) -> bool:
    return getattr(options, name) != getattr(CourseOptions(), name)


def _copy(folder: Path, options: CourseOptions) -> int:
    """Write the notebooks and say how to open them, or open them."""
    from ..course.copies import (
        FIRST,
        copy_for_class,
        copy_for_learner,
        docs_folder,
        documentation_pages,
        notebooks_folder,
    )
    from ..course.short_path import SHORT_PATH

    short = options.path == "short"
    if options.for_class:
        docs = docs_folder()
        pages = None if docs is None else documentation_pages(docs)
        notebooks = copy_for_class(notebooks_folder(), folder, pages, short=short)
    else:
        notebooks = copy_for_learner(folder, short=short)
    for path in notebooks:
        print(f"wrote {path}")
    first = str(folder / (SHORT_PATH if short else FIRST))
    if not options.open:
        word = quoted(first, windows=sys.platform == "win32")
        print(f"The notebooks are in {folder}. To open the first one: jupyter lab {word}")
        return 0
    return subprocess.call([sys.executable, "-m", "jupyter", "lab", first])


def quoted(path: str, *, windows: bool) -> str:
    """A path as one word of a command line; Windows knows double quotes only."""
    return subprocess.list2cmdline([path]) if windows else shlex.quote(path)
