"""``gsfusion-nb ... | head``: whoever reads the output has enough, so the command ends without a word."""

import os
import select
import sys

STATUS = 141
"""Exit status, as of a program that the signal SIGPIPE ended."""


def nobody_reads() -> bool:
    """After a ``BrokenPipeError``: whether it was the standard output that broke, and no socket."""
    try:
        place = sys.stdout.fileno()
    except (OSError, ValueError):  # no file, as in a notebook
        return False
    if not hasattr(select, "poll"):
        return True
    watch = select.poll()
    watch.register(place, 0)  # errors are told without being asked for
    return bool(watch.poll(0))


def write_nothing_more() -> None:
    """Let what is still in the buffer of the standard output go nowhere, so that Python's end says nothing, either."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
