"""``PYTHONPATH=tools python -m book runs/book`` builds the web book; see docs/book.md."""

import argparse
import logging
import sys
from pathlib import Path

from quiz import bank
from quiz_files import pages

from .assemble import read_settings
from .build import build, missing

_ROOT = Path(__file__).resolve().parents[2]


def main(arguments: list[str] | None = None) -> int:
    """Build the book; 1 if it could not be built, or a link leads nowhere."""
    parser = argparse.ArgumentParser(prog="python -m book", description="Builds the web book.")
    parser.add_argument("out", type=Path, nargs="?", default=Path("runs/book"), help="folder of the site; replaced")
    parser.add_argument("--installed", action="store_true", help="only say whether the extra 'book' is installed")
    words = "chapters whose live views are recorded, such as 03,08; all by default, '' for none"
    parser.add_argument("--views", default=None, help=words)
    parser.add_argument("--repository", default="", help="address of the repository, for links to Binder and Colab")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    if options.installed:
        return 1 if missing() else 0
    try:
        settings = read_settings(_ROOT / "docs/book/book.toml", options.repository)
        views = None if options.views is None else [name for name in options.views.split(",") if name]
        quiz = pages(bank(_ROOT / "notebooks"))
        wrong = build(_ROOT, options.out, settings, views=views, quiz=quiz)
    except (RuntimeError, ValueError, OSError) as e:
        logging.error("%s", e)
        return 1
    for sentence in wrong:
        logging.error("%s", sentence)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
