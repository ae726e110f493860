"""Change the program at random places and see whether a test fails.

    python tests/campaign/mutants.py --sample 40 --minutes 120      # of each room; prints a table

A mutant is the program with one small change, made by an operator of Cosmic Ray (pip install
cosmic-ray coverage). It is killed by a test that fails, and survives if all tests pass that execute
the changed line. First the tests of each room run once under coverage, which says what each of them
executes. Then each mutant is tested in a process of its own (a fork of this one), until the first
failure.

``survivors.toml`` lists mutants that may survive, each with a reason: "equivalent" if nothing that
the program promises is another, "untested" if it is not worth a test. Survivors that are not listed
are printed.
"""

import argparse
import dataclasses
import hashlib
import json
import os
import sys
import tempfile
import time
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path

for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

ROOT = Path(__file__).resolve().parents[2]
SURVIVORS = Path(__file__).with_name("survivors.toml")
ROOMS = (
    "render",
    "tsdf",
    "gaussians",
    "optim",
    "evaluation",
    "seeding",
    "code_keys",
    "tracking",
    "data",
    "mapping",
    "compare",
)
TESTS = (
    *(
        "geometry",
        "tsdf",
        "gaussians",
        "render",
        "seeding",
        "code_keys",
        "optim",
        "tracking",
        "export",
        "evaluation",
        "mapping",
    ),
    *("data", "recordings", "runs", "compare", "kernels"),
)
"""Folders of the tests that count."""
SURVIVED = ("survived", "not executed")
"""What becomes of a mutant that no test notices."""


def main() -> int:
    """Run a campaign and print its table; 1 if fewer mutants of a room were killed than there must
    be."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--rooms", nargs="+", choices=ROOMS, default=list(ROOMS), help="all by default"
    )
    parser.add_argument(
        "--tests",
        nargs="+",
        choices=TESTS,
        default=list(TESTS),
        help="folders of tests; all by default",
    )
    parser.add_argument("--sample", type=int, default=40, help="mutants of each room")
    parser.add_argument("--seed", type=int, default=0, help="another seed draws other mutants")
    parser.add_argument(
        "--minutes", type=float, default=120.0, help="no further mutant is begun after so long"
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=30.0,
        help="of tests for one mutant; with more, tests that run whole maps are among them",
    )
    parser.add_argument(
        "--least", type=float, default=90.0, help="per cent of each room's mutants to be killed"
    )
    parser.add_argument(
        "--again", type=Path, help="only the survivors of an earlier --results file"
    )
    parser.add_argument(
        "--results",
        type=Path,
        help="file for the verdicts, one a line; what it has is not run again",
    )
    parser.add_argument(
        "--keep", type=Path, help="folder that keeps the coverage for the next call"
    )
    parser.add_argument("--root", type=Path, default=ROOT, help="the checkout, by default this one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="mutants") as folder:
        verdicts = campaign(options, Path(folder))
    rooms = by_room(verdicts, listed())
    sys.stdout.write(report(verdicts, listed()))
    return 1 if any(killed(counts) < options.least for counts in rooms.values()) else 0


def campaign(options: argparse.Namespace, folder: Path) -> list[dict]:
    """The verdicts: for each mutant what it is, and what became of it."""
    from mutant_sites import sample
    from mutant_tests import copy_of, load_once, verdict, warm

    end = time.monotonic() + 60 * options.minutes
    tree = copy_of(options.root, folder / "tree")
    load_once()
    warm(tree, [f"tests/{folder}" for folder in options.tests], folder / "scratch")
    coverage = measured(
        tree, options.tests, options.keep or folder / "coverage", folder / "scratch"
    )
    verdicts = read_verdicts(options.results) if options.results else []
    known = {(v["operator"], v["occurrence"], *key_of(v)) for v in verdicts}
    if options.again:
        found = [v for v in read_verdicts(options.again) if v["verdict"] in SURVIVED]
        mutants = [moved for v in found for moved in moved_to(tree, v)]
    else:
        mutants = [
            m
            for room in options.rooms
            for m in sample(tree, f"gsfusion_nb/{room}", options.sample, options.seed)
        ]
    for mutant in mutants:
        if (mutant.operator, mutant.occurrence, *mutant.key) in known:
            continue
        if time.monotonic() > end:
            sys.stdout.write("the time is over; not all mutants of the sample were run\n")
            break
        tests = coverage.of(mutant, options.seconds)
        spent = sum(coverage.seconds[test] for test in tests)
        what = verdict(tree, mutant, tests, spent, folder / "scratch") if tests else "not executed"
        verdicts.append({"verdict": what, "tests": len(tests), **dataclasses.asdict(mutant)})
        if options.results:
            with options.results.open("a") as file:
                file.write(json.dumps(verdicts[-1]) + "\n")
        sys.stderr.write(
            f"{time.strftime('%H:%M:%S')} {what}, {len(tests)} tests of {spent:.0f} s: {mutant}\n"
        )
    return verdicts


def measured(tree: Path, folders: Sequence[str], kept: Path, scratch: Path):
    """The coverage of some folders of tests; what ``kept`` has of the same files is not measured
    again."""
    from mutant_tests import covered, read_coverage

    kept = kept.resolve()  # the processes that measure work in the copy
    kept.mkdir(parents=True, exist_ok=True)
    digest = hashlib.sha256()
    for path in sorted((tree / "gsfusion_nb").rglob("*.py")):
        digest.update(path.read_bytes())
    files = []
    for folder in folders:
        own = digest.copy()
        for path in sorted((tree / "tests" / folder).rglob("*.py")):
            own.update(path.read_bytes())
        files.append(kept / f"{folder}-{own.hexdigest()[:16]}.json")
        if not files[-1].exists():
            sys.stderr.write(f"measuring tests/{folder}\n")
            covered(tree, [f"tests/{folder}"], scratch, files[-1])
    return read_coverage(files)


def moved_to(tree: Path, verdict: dict):
    """The same mutant where its line is today, if it is anywhere; of any operator if none is
    named."""
    from mutant_sites import described, sites

    path = tree / verdict["file"]
    source = path.read_text("utf-8") if path.exists() else ""
    lines = [" ".join(line.split()) for line in source.splitlines()]
    for site, kinds in sites(source).items():
        if lines[site[0] - 1] not in verdict["original"]:
            continue
        for operator, occurrence in kinds:
            if operator == verdict.get("operator", operator):
                mutant = described(verdict["file"], source, site, operator, occurrence)
                if mutant.key == key_of(verdict):
                    yield mutant
                    return


def read_verdicts(file: Path) -> list[dict]:
    """What an earlier call has written."""
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def key_of(verdict: dict) -> tuple[str, str, str]:
    """What names a mutant wherever its line has moved to."""
    return verdict["file"], verdict["original"], verdict["changed"]


def entries() -> dict[tuple[str, str, str], dict[str, str]]:
    """What ``survivors.toml`` says of each mutant that it lists: "kind" and "reason"."""
    groups = tomllib.loads(SURVIVORS.read_text("utf-8"))
    return {
        key_of(entry): entry | {"kind": kind} for kind, some in groups.items() for entry in some
    }


def listed() -> dict[tuple[str, str, str], str]:
    """Mutant -> "equivalent" or "untested", from ``survivors.toml``."""
    return {key: entry["kind"] for key, entry in entries().items()}


def of_list(
    verdict: dict,
    known: dict[tuple[str, str, str], str],
) -> str:
    """The verdict; for a survivor that is listed, as what."""
    what = str(verdict["verdict"])
    return known.get(key_of(verdict), what) if what in SURVIVED else what


KINDS = ("killed", "timed out", "survived", "not executed", "untested", "equivalent")


def by_room(
    verdicts: Iterable[dict],
    known: dict[tuple[str, str, str], str],
) -> dict[str, Counter]:
    """How many mutants of each room ended as what."""
    rooms: dict[str, Counter] = defaultdict(Counter)
    for verdict in verdicts:
        rooms[verdict["file"].split("/")[1]][of_list(verdict, known)] += 1
    return dict(rooms)


def killed(counts: Counter) -> float:
    """Share of those that change behaviour, per cent; one that does not end is killed."""
    real = counts.total() - counts["equivalent"]
    return 100 * (counts["killed"] + counts["timed out"]) / real if real else 100.0


def report(
    verdicts: Iterable[dict],
    known: dict[tuple[str, str, str], str],
) -> str:
    """The survivors that are not listed, and a table by room."""
    lines = []
    for verdict in verdicts:
        if (what := of_list(verdict, known)) in SURVIVED:
            lines.append(f"{what}: {verdict['file']}:{verdict['line']}")
            lines += [f"    - {verdict['original']}", f"    + {verdict['changed']}"]
    rooms = by_room(verdicts, known)
    rows = [*rooms.items(), ("together", sum(rooms.values(), Counter()))]
    table = [("room", "mutants", *KINDS, "killed, %")]
    table += [
        (name, counts.total(), *(counts[k] for k in KINDS), f"{killed(counts):.0f}")
        for name, counts in rows
    ]
    return "\n".join([*lines, "", *(" ".join(f"{cell:>12}" for cell in row) for row in table), ""])


if __name__ == "__main__":
    sys.exit(main())
