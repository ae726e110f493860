"""Press Ctrl-C at random moments while a run maps and optimises, call it again each time, and
compare its maps.

    python tests/campaign/interrupts.py --tries 24

The signals are real ones, as in a notebook, and the figures are printed.

Every try is a run of this process on the built-in room at 80x60. Another thread sends SIGINT to the
process after random times, also while Python clears up after the one before.
"""

import argparse
import contextlib
import os
import random
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

from kills import ROOM, VARIANTS, settings

from gsfusion_nb.data import open_sequence
from gsfusion_nb.mapping import make_mapper
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.runs.map_hashes import map_hashes


@dataclass
class Figures:
    """What a campaign found."""

    tries: int = 0
    interrupts: int = 0
    """KeyboardInterrupts that ended a call."""
    others: list[str] = field(default_factory=list)
    """Errors of another kind that a call ended with."""
    different: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        said = (
            f"{self.tries} runs, {self.interrupts} interrupts; {len(self.different)} with other "
            "maps"
        )
        return "\n".join([said, *self.different, *self.others])


class Presses:
    """A thread that presses Ctrl-C at random moments, in pauses of up to ``most_s``, until it is
    told to stop."""

    def __init__(self, seed: int, most_s: float):
        self._draw = random.Random(seed)
        self._most_s = most_s
        self._ends = threading.Event()
        self._may = threading.Event()
        self._thread = threading.Thread(target=self._press, daemon=True)
        self._thread.start()

    def _press(self) -> None:
        while not self._ends.is_set():
            self._may.wait()
            time.sleep(self._draw.uniform(0.0, self._most_s))
            if self._may.is_set() and not self._ends.is_set():
                os.kill(os.getpid(), signal.SIGINT)

    def begin(self) -> None:
        """Press from now on."""
        self._may.set()

    def pause(self) -> None:
        """Press no more, until ``begin``."""
        self._may.clear()

    def stop(self) -> None:
        """End the thread."""
        self._ends.set()
        self._may.set()
        self._thread.join()


def new_run(variant: tuple[str, str]) -> MappingRun:
    """A run of a variant, before its first frame."""
    config = settings(*variant)
    return MappingRun(open_sequence("room", data=config.data, **ROOM), make_mapper(config))


def press_and_go_on(run: MappingRun, presses: Presses, figures: Figures) -> None:
    """Do a whole run while Ctrl-C is pressed."""

    def call() -> None:
        for _ in run.online():
            pass
        for _ in run.optimise():
            pass
        presses.pause()

    presses.begin()
    settled(call, figures)
    settled(presses.stop, figures)


def settled(call: Callable[[], Any], figures: Figures) -> None:
    """Make a call again until no Ctrl-C ends it."""
    while True:
        try:
            try:
                call()
                return
            except Exception as e:
                figures.others.append(f"{type(e).__name__}: {e}")
                return
        except KeyboardInterrupt:
            with contextlib.suppress(KeyboardInterrupt):
                figures.interrupts += 1


def campaign(
    tries: int,
    seed: int,
    variants: list[str],
    most_s: float,
) -> Figures:
    """Runs of all ``variants`` in turn, while Ctrl-C is pressed."""
    figures = Figures()
    whole = {}
    for variant in variants:
        run = new_run(VARIANTS[variant])
        began = time.monotonic()
        for _ in run.online():
            pass
        for _ in run.optimise():
            pass
        whole[variant] = map_hashes(run)
        sys.stderr.write(f"{variant}: {time.monotonic() - began:.1f} s without an interrupt\n")
    for n in range(tries):
        variant = variants[n % len(variants)]
        run = new_run(VARIANTS[variant])
        press_and_go_on(run, Presses(seed + n, most_s), figures)
        figures.tries += 1
        found = map_hashes(run)
        if found != whole[variant]:
            names = [name for name in found if found[name] != whole[variant][name]]
            figures.different.append(f"{variant}, try {n}: other {', '.join(names)}")
        sys.stderr.write(
            f"{n + 1} of {tries}: {figures.interrupts} interrupts, {len(figures.different)} "
            "different\n"
        )
    return figures


def main() -> int:
    """Run a campaign and print its figures; 1 if a map differed, or an error of another kind
    came."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tries", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--most-s", type=float, default=1.0, help="longest time between two presses"
    )
    parser.add_argument(
        "--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS), help="all by default"
    )
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    figures = campaign(options.tries, options.seed, options.variants, options.most_s)
    sys.stdout.write(f"{figures}\n")
    return 1 if figures.different or figures.others else 0


if __name__ == "__main__":
    sys.exit(main())
