"""Damaged and hostile files, thousands of them: every one ends in a sentence, or is accepted
rightly.

    python tests/campaign/fuzz.py --inputs 20000 --seed 1 --keep /tmp/offending
    python tests/campaign/fuzz.py --inputs 1200 --target altered

The target "altered" is checkpoints, TSDFs, and what another recording goes on with (places.npz,
state.zip), whose checksums are right.

Each input is made from its number and the seed alone, so ``--only 1234`` repeats one. Inputs are
read in forked copies of a warm process, each input with 10 s and 1 GB.
"""

import argparse
import json
import os
import random
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import alter
import corpus
import mutate
import targets

SECONDS = 10
MEMORY_BYTES = 1_000_000_000
BATCH = 40
CLEAN = "clean errors"
ACCEPTED = "accepted"
BAD = ("tracebacks", "crashes", "hangs", "memory", "silent acceptances")


@dataclass
class Figures:
    """What became of the inputs."""

    counts: Counter = field(default_factory=Counter)
    offending: list[dict] = field(default_factory=list)
    seconds: float = 0.0

    def add(self, number: int, kind: str, text: str) -> None:
        """Note an input that did not end well, and say so at once."""
        self.offending.append({"input": number, "kind": kind, "text": text})
        print(f"{kind}, input {number}: {text}\n", flush=True)

    def __str__(self) -> str:
        n = sum(self.counts.values())
        rows = [
            f"{n:8} inputs in {self.seconds:.0f} s",
            *(f"{self.counts[k]:8} {k}" for k in (CLEAN, ACCEPTED, *BAD)),
        ]
        return "\n".join(rows)


class Hang(BaseException):
    """Raised by the signal with which the parent ends an input that takes too long."""


class Campaign:
    """A corpus and a seed: input ``i`` is always the same."""

    def __init__(self, root: Path, seed: int, only: str = ""):
        self.root = root
        self.seed = seed
        (root / "corpus").mkdir(parents=True)
        (root / "bombs").mkdir()
        self.seeds = [
            made for made in corpus.build(root / "corpus") if made.target.startswith(only)
        ]
        self.bombs = [] if only else corpus.bombs(root / "bombs")
        files = [
            p for p in (root / "corpus").rglob("*") if p.is_file() and p.stat().st_size < 200_000
        ]
        self.others = [p.read_bytes() for p in files[:: max(1, len(files) // 60)]]

    def make(
        self,
        i: int,
        folder: Path,
    ) -> tuple[corpus.Seed, Path, Path | None]:
        """Write input ``i`` to ``folder``: its seed, what is to be opened, and the damaged file."""
        rng = random.Random(f"{self.seed}/{i}")
        if i < len(self.bombs):
            seed = self.bombs[i]
            shutil.copytree(seed.root, folder)
            return seed, folder / seed.entry, None
        seed = rng.choice(self.seeds)
        name = seed.root.name if seed.target == "sequence" else "input"
        place = folder / name
        shutil.copytree(seed.root, place)
        if seed.target.startswith("altered"):
            made = alter.ALTERERS[seed.target](place, rng)
            made.write(folder / targets.ALTERATION)
            return seed, place, None
        files = sorted(p for p in place.rglob("*") if p.is_file())
        plain = [p for p in files if p.suffix.lower() not in (".png", ".jpg", ".npy")]
        chosen = (
            place / seed.entry if (place / seed.entry).is_file() else rng.choice(plain * 3 + files)
        )
        if rng.randrange(40) == 0:
            _replace(chosen, rng)
        else:
            chosen.write_bytes(
                mutate.mutated(
                    chosen.read_bytes(),
                    chosen.name,
                    rng,
                    self.others,
                )
            )
        return seed, place / seed.entry, chosen

    def judge(self, i: int, folder: Path) -> tuple[str, str]:
        """Read input ``i`` here; what it counts as, and the sentence."""
        seed, path, chosen = self.make(i, folder)
        targets.HEARD.sentences.clear()
        _restart_peak()
        before = _memory("VmRSS")
        try:
            targets.TARGETS[seed.target](path)
            kind = ACCEPTED
            text = ""
            is_json = (
                chosen is not None
                and chosen.is_file()
                and chosen.name.endswith((".json", "metadata"))
                and not any(chosen.match(pattern) for pattern in seed.beside)
            )
            if chosen is not None and is_json and seed.target not in targets.CORRECTED:
                fault = targets.strict_json_fault(chosen)
                kind, text = ("silent acceptances", fault) if fault else (kind, text)
        except Hang as e:
            kind = "hangs"
            text = "".join(traceback.format_exception(e))[-900:]
        except targets.SilentAcceptance as e:
            kind = "silent acceptances"
            text = str(e)
        except BaseException as e:
            kind = _kind_of(e, folder)
            text = "".join(traceback.format_exception(e))[-900:]
        if _memory("VmHWM") - before > MEMORY_BYTES:
            kind = "memory"
            text = f"{(_memory('VmHWM') - before) / 1e9:.2f} GB; {text}"
        return (
            kind,
            f"{seed.name} ({seed.target}), {chosen.name if chosen else 'made to harm'}: {text}",
        )


def _kind_of(error: BaseException, folder: Path) -> str:
    text = str(error.args[0] if isinstance(error, KeyError) and error.args else error)
    if isinstance(error, MemoryError) or any(
        w in text for w in ("more memory than", "Unable to alloc", "t allocate")
    ):
        return "memory"
    ours = isinstance(error, (ValueError, OSError, KeyError))
    names = {p.name for p in folder.rglob("*")} | {folder.name, "input"}
    sentence = (
        "\n" not in text.strip() and 20 < len(text) < 1500 and any(name in text for name in names)
    )
    foreign = isinstance(error, UnicodeError) or type(error).__module__.split(".")[0] not in (
        "builtins",
        "gsfusion_nb",
    )
    return CLEAN if ours and sentence and not foreign else "tracebacks"


def _replace(path: Path, rng: random.Random) -> None:
    """Something that is no plain file in the place of one."""
    path.unlink()
    way = rng.randrange(6)
    if way == 0:
        os.mkfifo(path)
    elif way == 1:
        path.mkdir()
    elif way == 2:
        path.symlink_to("/dev/zero")
    elif way == 3:
        path.symlink_to(path)
    elif way == 4:
        path.write_bytes(b"")
    # else: it is missing


def _restart_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def _memory(name: str) -> int:
    text = Path("/proc/self/status").read_text()
    return next(
        int(line.split()[1]) * 1024 for line in text.splitlines() if line.startswith(f"{name}:")
    )


def _child(campaign: Campaign, numbers: list[int], write: int) -> None:
    """Judge inputs one after another and tell the parent of each."""
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)

    def hang(number: int, frame: object) -> None:
        raise Hang

    signal.signal(signal.SIGUSR1, hang)
    most = _memory("VmSize") + MEMORY_BYTES + 500_000_000
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000_000, 2_000_000_000))
    with os.fdopen(write, "w", buffering=1) as told:
        for i in numbers:
            folder = campaign.root / f"inputs/{i}"
            folder.parent.mkdir(exist_ok=True)
            try:
                kind, text = campaign.judge(i, folder)
            except Hang as e:
                kind = "hangs"
                trace = "".join(traceback.format_exception(e))
                text = f"while it was made or measured: {trace[-900:]}"
            told.write(json.dumps([i, kind, text]) + "\n")
            shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)


def run(
    campaign: Campaign,
    numbers: list[int],
    keep: Path | None = None,
) -> Figures:
    """Judge inputs by number, and keep those that did not end well."""
    figures = Figures()
    start = time.monotonic()
    left = list(numbers)
    while left:
        batch = left[:BATCH]
        read, write = os.pipe()
        child = os.fork()
        if child == 0:
            try:
                os.close(read)
                _child(campaign, batch, write)
            finally:
                os._exit(1)  # or the end of the parent's blocks would remove its corpus
        os.close(write)
        done = _listen(child, read, figures)
        status = os.waitpid(child, 0)[1]
        if done < len(batch):
            signalled = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
            kind = "hangs" if signalled == signal.SIGKILL else "crashes"
            figures.counts[kind] += 1
            figures.add(batch[done], kind, f"status {status}")
            done += 1
        left = left[done:]
        if (len(numbers) - len(left)) % (BATCH * 5) == 0:
            print(f"{len(numbers) - len(left)} {dict(figures.counts)}", flush=True)
    figures.seconds = time.monotonic() - start
    for row in figures.offending if keep else ():
        campaign.make(
            row["input"], Path(keep or "") / f"{row['kind'].replace(' ', '-')}-{row['input']}"
        )
    return figures


def _listen(child: int, read: int, figures: Figures) -> int:
    """Take in the results of a child until it ends or does not answer any more; how many came."""
    done = 0
    rest = b""
    clock = _Clock(child)
    try:
        while True:
            ready, _, _ = select.select([read], [], [], SECONDS / 4)
            if not ready:
                if clock.is_over():
                    os.kill(child, signal.SIGUSR1 if clock.warned == 1 else signal.SIGKILL)
                if clock.warned > 1:
                    return done
                continue
            block = os.read(read, 1 << 16)
            if not block:
                return done
            clock = _Clock(child)
            *lines, rest = (rest + block).split(b"\n")
            for line in lines:
                i, kind, text = json.loads(line)
                figures.counts[kind] += 1
                done += 1
                if kind in BAD:
                    figures.add(i, kind, text)
    finally:
        os.close(read)


class _Clock:
    """Ten seconds of work, or of waiting for something that does not come.

    On a machine with more work than cores a process that waits for its turn is neither.
    """

    def __init__(self, child: int):
        self._stat = Path(f"/proc/{child}/stat")
        self._start = self._last = self._cpu_s()[0]
        self._idle_s = 0.0
        self.warned = 0

    def is_over(self) -> bool:
        """Called every quarter of the time that an input has."""
        now, state = self._cpu_s()
        self._idle_s = self._idle_s + SECONDS / 4 if state in "SDT" and now == self._last else 0.0
        self._last = now
        if self._idle_s < SECONDS and now - self._start < SECONDS:
            return False
        self.warned = self.warned + 1
        self._idle_s = 0.0
        self._start = now
        return True

    def _cpu_s(self) -> tuple[float, str]:
        words = self._stat.read_text().rsplit(")", 1)[1].split()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK"), words[0]


def warm() -> None:
    """Import what readers import late, once, in the process that is copied."""
    import logging

    import cv2
    import torch

    cv2.setNumThreads(0)
    torch.set_num_threads(1)
    logging.getLogger().addHandler(targets.HEARD)
    logging.getLogger("gsfusion_nb").addHandler(targets.HEARD)


def main() -> int:
    """Run a campaign; the exit status is 1 if an input did not end well."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=2000)
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int, nargs="*", help="numbers of single inputs")
    parser.add_argument(
        "--target", default="", help="only inputs that are read so: altered, convert, resume, ..."
    )
    parser.add_argument("--keep", type=Path, help="folder for inputs that did not end well")
    options = parser.parse_args()
    warm()
    with tempfile.TemporaryDirectory(prefix="gsfusion-nb-campaign-") as root:
        campaign = Campaign(Path(root), options.seed, options.target)
        numbers = options.only or list(range(options.first, options.first + options.inputs))
        figures = run(campaign, numbers, options.keep)
    print(figures)
    return 1 if figures.offending else 0


if __name__ == "__main__":
    sys.exit(main())
