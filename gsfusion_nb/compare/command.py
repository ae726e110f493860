"""``gsfusion-nb lab``: a comparison from a file, with all its outputs in a folder."""

import dataclasses
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..backends import backend_names, from_environment, use_backend
from ..checks import check_name
from ..config.options import named
from ..errors import ArgumentError
from ..files import write_file
from ..runs.run_folder import RunFolder
from .executors import NoWorkerError, executor
from .map_scene import Entry
from .outputs import Results, Table
from .paired_tests import TESTS
from .run_all import ResultStore, run_all
from .run_result import RunResult
from .spec import RunSpec
from .table_file import EXAMPLE, read_table
from .tune import is_tuned

RENEW_S = 30.0
"""Seconds between two writings of the tables while runs are done."""
TUNED_RUNS = 4.0
"""Work of a run whose size is tuned, in runs."""


@dataclass(frozen=True, kw_only=True)
class WhereOptions:
    """Where runs are done, and where their results go."""

    out: str = ""
    """Folder for the results. Default: runs/ and the name of the file."""
    jobs: int = 1
    """Number of processes on this machine; each uses its share of the cores."""
    dask: str = ""
    """Address of the scheduler of a Dask cluster, such as tcp://host:8786, or "local" for one of
    --jobs workers on this machine. The workers must find the data under the same paths. Needs the
    extra "cluster"."""
    reference: str = ""
    """Name of the row that all others are tested against. It must not be chosen by the results.
    Default: the rule gsfusion where it takes part, else the first row."""
    tests: str = named("", lambda: [f"{name} ({what})" for name, what in TESTS.items()])
    """What is tested at each budget. Default: what the file says, else reference."""
    cache: bool = True
    """Use results of earlier commands from the cache, whatever their --out, and keep new ones
    there. With --no-cache they are kept in the folder of --out."""
    backend: str = named(from_environment, backend_names)
    """What the operations run on; the environment variable GSFUSION_BACKEND changes the default."""


@dataclass(frozen=True, kw_only=True)
class LabOptions(WhereOptions):
    """Compare seeding rules: rules x scenes x seeds x budgets, as a file says.

    Writes runs.csv, table.md, table.json, paper.tex, a figure and a page. After Ctrl-C the same
    command continues; no run is computed twice, also in later commands."""

    table: Annotated[str, tyro.conf.Positional] = ""
    """The file that describes the comparison (TOML)."""
    rule_file: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A file of rules, losses or optimisers that the table names, such as --rule-file my_rules.py:
    its code is executed only if it is named here, or after a question. Repeat it for several
    files."""
    system_file: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """The file of the system that the table names, if it is in one, such as --system-file
    my_system.py: the same holds for its code."""
    new: str = ""
    """Write a commented example to this file, and do nothing else."""


def main(options: LabOptions) -> int:
    """Run the command. Returns the exit status: 0, 1 if a run failed, or 130 if it was interrupted.

    Raises:
        ValueError: mistakes in the file. FileNotFoundError: no such file. FileExistsError: ``new``
            exists already.
    """
    if options.new:
        return _write_example(Path(options.new).expanduser())
    if not options.table:
        raise ArgumentError(
            "expected the file of a comparison: gsfusion-nb lab table.toml (--new table.toml "
            "writes one)"
        )
    with use_backend(options.backend):
        table = read_table(
            options.table, rule_files=options.rule_file, system_files=options.system_file
        )
        print(table)
        folder = Path(options.out or f"runs/{Path(options.table).stem}").expanduser()
        return run_and_write(table.specs, folder, options, table=table)[0]


def run_and_write(
    specs: Sequence[RunSpec], folder: Path, options: WhereOptions, *, table: Table | None = None
) -> tuple[int, list[RunResult]]:
    """Run all ``specs``, print each result as it comes, and write the outputs. Returns exit status
    and results.

    Tables are written anew while it runs, at most every ``RENEW_S`` seconds; page and figure at the
    end.

    Raises:
        FileExistsError: another command is writing to ``folder``. KeyError: no such row to test
            against, or no such test.
    """
    table = _as_asked(table or Table(specs=list(specs)), options)
    results = dict[int, RunResult]()
    with RunFolder(folder):
        store = ResultStore(None if options.cache else folder)
        began = renewed_s = time.perf_counter()
        is_interrupted = False
        loss = ""
        work = 0.0
        todo = {i: TUNED_RUNS if is_tuned(spec) else 1.0 for i, spec in enumerate(specs)}
        try:
            missing = {spec.key for spec in specs if store.find(spec) is None}
            print(f"{len(missing)} of {len(specs)} runs to compute", flush=True)
            with executor(options.jobs, options.dask) as where:
                for i, result in run_all(
                    [Entry(spec=spec) for spec in specs],
                    store,
                    where,
                ):
                    results[i] = result
                    work += 0.0 if result.copied_from else todo[i]
                    del todo[i]
                    remaining = _time_left(
                        sum(todo.values(), 0.0),
                        work,
                        time.perf_counter() - began,
                    )
                    print(
                        f"[{len(results):3d}/{len(specs)}] {describe(result)}{remaining}",
                        flush=True,
                    )
                    if len(results) < len(specs) and time.perf_counter() - renewed_s > RENEW_S:
                        Results(runs=_in_order(results), about=table, store=store).write(
                            folder, pictures=False
                        )
                        renewed_s = time.perf_counter()
        except KeyboardInterrupt:
            is_interrupted = True
        except NoWorkerError as e:
            loss = f"error: {e}"
        ordered_results = _in_order(results)
        if ordered_results:
            Results(runs=ordered_results, about=table, store=store).write(folder)
            print(f"\n{(folder / 'table.md').read_text(encoding='utf-8')}")
    n_failures = sum(result.status == "failed" for result in ordered_results)
    took_s = time.perf_counter() - began
    print(
        f"{len(ordered_results)} of {len(specs)} runs in {took_s:.0f} s, {n_failures} failed; "
        f"files in {folder}"
    )
    if is_interrupted:
        print("Interrupted: the same command continues.")
        return 130, ordered_results
    if loss:
        print(loss, file=sys.stderr)
    return 1 if n_failures or loss else 0, ordered_results


def _as_asked(table: Table, options: WhereOptions) -> Table:
    """The comparison with the reference and the tests of the command line.

    Raises:
        KeyError: there are no such ones.
    """
    reference = options.reference or table.reference
    tests = options.tests or table.tests
    if reference:
        check_name("row", reference, dict.fromkeys(spec.label for spec in table.specs))
    check_name("test", tests, TESTS)
    return dataclasses.replace(table, reference=reference, tests=tests)


def _time_left(work: float, work_done: float, elapsed_s: float) -> str:
    """How long the rest will take, judged by what was computed so far; empty before that, and at
    the end."""
    if not (work and work_done):
        return ""
    seconds = elapsed_s * work / work_done
    return (
        f"; about {seconds:.0f} s left" if seconds < 90 else f"; about {seconds / 60:.0f} min left"
    )


def describe(result: RunResult) -> str:
    """One line about a run."""
    spec = result.spec
    numbers = result.metrics
    name = f"{spec.scene}, {spec.label}, seed {spec.seed}, {spec.budget}"
    if result.status == "failed":
        return f"{name}: failed: {result.reason}"
    psnr = (
        f"{numbers['psnr_held_out_db']:.2f} dB held out, " if "psnr_held_out_db" in numbers else ""
    )
    origin = ", copied from the cache" if result.copied_from else ""
    return (
        f"{name}: {psnr}{numbers['n_gaussians']:,.0f} Gaussians, {numbers['n_steps']:,.0f} "
        f"steps{origin}"
    )


def _in_order(results: dict[int, RunResult]) -> list[RunResult]:
    """The results in the order of their runs."""
    return [results[i] for i in sorted(results)]


def _write_example(path: Path) -> int:
    if path.exists():
        raise FileExistsError(f"{path} exists already; choose another name for the example")
    write_file(path, EXAMPLE)
    print(f"wrote {path}; run it with: gsfusion-nb lab {path}")
    return 0
