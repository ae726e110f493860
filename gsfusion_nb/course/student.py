"""Copies of the notebooks for students, without the solutions; for teachers, with them; for one learner to work in.

``python -m gsfusion_nb.course.student SRC DST [--teacher | --learner]`` (the last: ``edition.py``). In a code cell
everything from the line ``### BEGIN SOLUTION`` to ``### END SOLUTION`` is a solution, in a text cell from
``<!-- BEGIN SOLUTION -->`` to ``<!-- END SOLUTION -->``. A cell that would be empty without it is left out. A student's
copy has no outputs, because they would show what the reader is asked to predict.
"""

import argparse
import json
import logging
import shutil
from pathlib import Path

from ..foreign import read_object
from .edition import hand_out
from .without_solutions import without_solutions

log = logging.getLogger(__name__)


def copy_course(source: Path, target: Path, *, solutions: bool = False) -> list[Path]:
    """Write the notebooks of a folder, or one notebook, into the folder ``target``. Returns the files written.

    Args:
        source: A folder of notebooks, or one notebook.
        target: Created if it does not exist. Notebooks of the same name in it are replaced.
        solutions: Keep solutions and outputs: an exact copy.

    Raises:
        ValueError: no notebook at ``source``, ``target`` is the source's folder, or unbalanced markers.
    """
    notebooks = [source] if source.is_file() else sorted(source.glob("*.ipynb"))
    if not notebooks:
        raise ValueError(f"there is no notebook at {source}")
    if target.resolve() == notebooks[0].parent.resolve():
        raise ValueError(f"the copies would replace the notebooks in {target}; choose another folder")
    target.mkdir(parents=True, exist_ok=True)
    written = []
    for path in notebooks:
        copied = target / path.name
        if solutions:
            shutil.copyfile(path, copied)
        else:
            try:
                notebook = without_solutions(read_object(path, "a notebook"))
            except ValueError as e:
                raise ValueError(f"{path}: {e}") from None
            text = json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"
            copied.write_text(text, encoding="utf-8")
        written.append(copied)
    return written


def main(arguments: list[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Copy the course's notebooks, without solutions or with them.")
    parser.add_argument("source", type=Path, help="folder of notebooks, or one notebook")
    parser.add_argument("target", type=Path, help="folder for the copies")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--teacher", action="store_true", help="keep solutions and outputs")
    kind.add_argument(
        "--learner", action="store_true", help="keep the outputs, and whatever was changed in the folder for the copies"
    )
    options = parser.parse_args(arguments)
    try:
        if options.learner:
            lines = [str(done) for done in hand_out(options.source, options.target) if done.state != "unchanged"]
        else:
            lines = [f"wrote {p}" for p in copy_course(options.source, options.target, solutions=options.teacher)]
    except ValueError as e:
        parser.error(str(e))
    for line in lines:
        log.info(line)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    main()
