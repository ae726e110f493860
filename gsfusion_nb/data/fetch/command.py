"""The command line of a data script: shared options, and errors without a traceback."""

import argparse
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ...last_resort import is_foreseen, unforeseen
from ...progress import ProgressDisplay
from .fetch_data_set import FetchOptions as FetchOptions


def parser(description: str, *, downloads: bool = True) -> argparse.ArgumentParser:
    """A parser with the options of all scripts. ``description``: the script's docstring; ``downloads``: whether it uses
    the network."""
    made = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--out", type=Path, default=Path("data"), help="folder of all data sets (default: data)")
    made.add_argument("--yes", action="store_true", help="agree to download size and licence without a question")
    if downloads:
        made.add_argument("--mirror", default="", metavar="URL", help="address of another host with the same paths")
        made.add_argument("--keep-archives", action="store_true", help="keep the downloaded archives in OUT/.fetch")
    return made


def fetch_options(options: argparse.Namespace) -> FetchOptions:
    """The options given on the command line; questions are asked only if standard input is a terminal."""
    return FetchOptions(
        out=options.out,
        yes=options.yes,
        mirror=getattr(options, "mirror", ""),
        keep_archives=getattr(options, "keep_archives", False),
        say=say,
        ask=input if sys.stdin is not None and sys.stdin.isatty() else None,
    )


def say(text: str) -> None:
    """Print to standard output without buffering."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def run(name: str, script: Callable[[], object]) -> int:
    """Run the body of a script. Exit status: 0 done, 1 an error (its message is printed), 130 interrupted."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    try:
        script()
    except Exception as e:
        text = str(e) if is_foreseen(e) else unforeseen(e, name, sys.argv[1:])
        sys.stderr.write(f"{name}: {text}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write(f"{name}: interrupted; run the same command again to continue\n")
        return 130
    return 0


@contextmanager
def counting(unit: str) -> Iterator[Callable[[int, int], object]]:
    """Show the progress of a loop that reports how many steps are done and how many there are."""
    with ProgressDisplay("written", unit=unit) as display:
        yield lambda done, count: display.show(done, total=count)
