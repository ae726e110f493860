"""The command line of a data script: options that all share, errors as sentences."""

import argparse
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ...last_resort import is_foreseen, unforeseen
from ...progress import ProgressDisplay
from .obtain import Terms as Terms


def parser(description: str, *, downloads: bool = True) -> argparse.ArgumentParser:
    """A parser with the options of every script. ``description``: its docstring; ``downloads``: does it use the net?"""
    made = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--out", type=Path, default=Path("data"), help="folder of all data sets (default: data)")
    made.add_argument("--yes", action="store_true", help="agree to size and licence without being asked")
    if downloads:
        made.add_argument(
            "--mirror", default="", metavar="URL", help="a host with the same paths, instead of the own one"
        )
        made.add_argument("--keep-archives", action="store_true", help="keep the downloaded archives in OUT/.fetch")
    return made


def terms(options: argparse.Namespace) -> Terms:
    """What was asked for on the command line; questions go to a person only where standard input is a terminal."""
    return Terms(
        out=options.out,
        yes=options.yes,
        mirror=getattr(options, "mirror", ""),
        keep_archives=getattr(options, "keep_archives", False),
        say=say,
        ask=input if sys.stdin is not None and sys.stdin.isatty() else None,
    )


def say(text: str) -> None:
    """One line or several on standard output, at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def run(name: str, script: Callable[[], object]) -> int:
    """Run a script's body; the exit status: 0 done, 1 an error said in a sentence, 130 interrupted."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    try:
        script()
    except Exception as e:
        text = str(e) if is_foreseen(e) else unforeseen(e, name, sys.argv[1:])
        sys.stderr.write(f"{name}: {text}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write(f"{name}: interrupted; the same command continues\n")
        return 130
    return 0


@contextmanager
def counting(unit: str) -> Iterator[Callable[[int, int], object]]:
    """Show the progress of a loop that tells how many it has done of how many."""
    with ProgressDisplay("written", unit=unit) as display:
        yield lambda done, count: display.show(done, total=count)
