"""``PYTHONPATH=tools python -m book runs/book`` builds the web book; see docs/book.md."""

import argparse
import logging
import sys
from pathlib import Path

from quiz import bank, by_chapter

from .assemble import read_settings
from .build import build, missing

_ROOT = Path(__file__).resolve().parents[2]


def main(arguments: list[str] | None = None) -> int:
    """Build the book; 1 if it could not be built."""
    parser = argparse.ArgumentParser(prog="python -m book", description="Builds the web book.")
    parser.add_argument("out", type=Path, nargs="?", default=Path("runs/book"), help="folder of the site; replaced")
    parser.add_argument("--installed", action="store_true", help="only say whether the extra 'book' is installed")
    parser.add_argument("--repository", default="", help="address of the repository, for links to source files")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    if options.installed:
        return 1 if missing() else 0
    try:
        settings = read_settings(_ROOT / "docs/book/book.toml", options.repository)
        build(_ROOT, options.out, settings, by_chapter(bank()))
    except (RuntimeError, ValueError, OSError) as e:
        logging.error("%s", e)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
