"""All runs of a comparison: what is known is taken from the store, the rest is computed, in any
order."""

import dataclasses
import logging
import uuid
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from ..backends import chosen
from ..files import cache_folder, read_sealed, write_file, write_sealed
from ..seeding import SeedingRule, is_built_in, registered
from .admission import Admission, admission
from .executors import Answer, Executor, InProcess, Task
from .map_scene import Entry
from .program import program_parts, run_key
from .rule_variants import original
from .run_result import RunResult
from .spec import ONLY_NOW, RunSpec, look_again
from .tune import is_tuned, tuning_spec

log = logging.getLogger(__name__)

T = TypeVar("T")

RESULTS = "results"
"""Folder of the results in a store."""


class ResultStore:
    """The results of all comparisons, with their pictures, by the keys of their runs.

    Args:
        folder: Where they are; ``lab`` in the cache folder of this package by default. It is
            created.
    """

    def __init__(self, folder: str | Path | None = None):
        self.folder = cache_folder() / "lab" if folder is None else Path(folder).expanduser()
        (self.folder / RESULTS).mkdir(parents=True, exist_ok=True)
        self._unreadable: set[Path] = set()
        """Files that were told to be useless."""

    def find(self, spec: RunSpec) -> RunResult | None:
        """The result of a run with the key of ``spec`` that is done, with the labels of ``spec``;
        None if none is.

        A file that is damaged or was changed is not used; one line names it.
        """
        if spec.not_kept:
            return None
        path = self.folder / RESULTS / f"{spec.key}.json"
        result = self._read(path, lambda path: RunResult.load(path, key=spec.key))
        if result is None or result.status != "done":
            return None
        return dataclasses.replace(result, spec=spec, copied_from=str(self.folder))

    def keep(self, result: RunResult) -> None:
        """Write a result."""
        result.save(self.folder / RESULTS / f"{result.key}.json")

    def find_tuned(self, spec: RunSpec) -> dict[str, Any] | None:
        """What ``tune`` found for ``tuning_spec(spec)``; None if that is not known."""
        path = self.folder / "tuned" / f"{tuning_key(spec)}.json"
        return self._read(path, lambda path: read_sealed(path, "the tuned option of a rule"))

    def keep_tuned(self, spec: RunSpec, tuned: dict[str, Any]) -> None:
        """Write what ``tune`` found for ``tuning_spec(spec)``."""
        write_sealed(self.folder / "tuned" / f"{tuning_key(spec)}.json", tuned)

    def _read(
        self,
        path: Path,
        load: Callable[[Path], T],
    ) -> T | None:
        """What ``load`` gives for a file; None if there is none, or it cannot be used, which is
        told once."""
        try:
            return load(path) if path.is_file() else None
        except (ValueError, OSError) as e:
            if path not in self._unreadable:
                log.warning("%s is not used, and computed again: %s", path, e)
            self._unreadable.add(path)
            return None


def tuning_key(spec: RunSpec) -> str:
    """Key of the tuning of ``spec``; equal for runs that differ only in their seed."""
    return run_key(tuning=tuning_spec(spec).key)


def run_all(
    entries: Sequence[Entry], store: ResultStore, executor: Executor | None = None
) -> Generator[tuple[int, RunResult], None, None]:
    """Run all ``entries``; yields position and result of each when it is there, each result written
    to ``store``.

    The data are looked at anew. Results in ``store`` are reused, runs with equal keys are done
    once, and runs that differ only in their seed are tuned once. When the caller stops, everything
    that was yielded is kept.

    Args:
        entries: The runs.
        store: Where results are kept.
        executor: Where the runs are done; in this process by default.
    """
    look_again()
    entries = with_code_of_now(entries)
    admissions = _Admissions(store)
    positions_of_key: dict[str, list[int]] = {}
    results: dict[int, RunResult] = {}
    for i, entry in enumerate(entries):
        result = store.find(entry.spec)
        if result is None:
            entries[i], result = admissions.ask(entry)
        if result is not None:
            results[i] = result
        else:
            positions_of_key.setdefault(entries[i].spec.key, []).append(i)
    # the first of equal runs is done, and its result is that of all of them
    remaining = {positions[0]: positions for positions in positions_of_key.values()}
    plan = _Plan(entries, store, executor or InProcess())
    plan.begin(list(remaining))
    yield from results.items()
    while remaining:
        for i, result in plan.next():
            if not result.spec.not_kept:
                store.keep(result)
            yield from (
                (k, dataclasses.replace(result, spec=entries[k].spec)) for k in remaining.pop(i)
            )


def with_code_of_now(entries: Sequence[Entry]) -> list[Entry]:
    """The runs with what their code is now; a run whose rule cannot be found, which will fail, as
    it is."""
    specs: dict[Any, RunSpec] = {}
    new_specs = []
    for entry in entries:
        spec = entry.spec
        place = (
            id(entry.rule),
            spec.rule,
            spec.rule_source,
            spec.rule_folder,
            spec.system,
            spec.system_source,
            spec.system_folder,
            repr(spec.training),
            repr(spec.options),
        )
        if place not in specs:
            try:
                specs[place] = spec.with_code(original(entry.found_rule()))
            except (KeyError, ValueError, TypeError, OSError):
                specs[place] = dataclasses.replace(spec, code=None)
        new_spec = specs[place]
        new_specs.append(
            dataclasses.replace(
                entry,
                spec=dataclasses.replace(spec, code=new_spec.code, not_kept=new_spec.not_kept),
            )
        )
    return new_specs


class _Admissions:
    """Asks once for each entrant whether it may take part."""

    def __init__(self, store: ResultStore):
        self._folder = store.folder / "checks"
        self._answers: dict[str, Admission] = {}
        self._only_now: dict[str, str] = {}

    def ask(self, entry: Entry) -> tuple[Entry, RunResult | None]:
        """The run, with why its result is not kept if the check found that; and its result if it is
        refused."""
        spec = entry.spec
        question = repr(
            (spec.rule, sorted((spec.code or {}).items()), sorted(map(repr, spec.options.items())))
        )
        if question not in self._answers:
            self._answers[question] = self._check(entry)
        answer = self._answers[question]
        if answer.refused:
            return entry, RunResult(spec=spec, status="failed", reason=answer.refused)
        if answer.not_kept:
            token = self._only_now.setdefault(question, uuid.uuid4().hex)
            code = {**(spec.code or {}), ONLY_NOW: token}
            entry = dataclasses.replace(
                entry, spec=dataclasses.replace(spec, code=code, not_kept=answer.not_kept)
            )
        return entry, None

    def _check(self, entry: Entry) -> Admission:
        if not entry.spec.code:
            return Admission()
        try:
            return admission(entry, self._folder)
        except (KeyError, ValueError, TypeError, OSError) as e:
            return Admission(refused=f"{type(e).__name__}: {e}")


class _Plan:
    """Tuning first; then the runs that waited for it."""

    def __init__(self, entries: Sequence[Entry], store: ResultStore, executor: Executor):
        self._entries = entries
        self._store = store
        self._executor = executor
        self._waiting: dict[int, list[int]] = {}
        """Number of a tuning -> the runs that wait for it."""

    def begin(self, runs: list[int]) -> None:
        """Put the runs, by position, or the tunings that they need."""
        waiting: dict[str, list[int]] = {}
        for i in runs:
            spec = self._entries[i].spec
            is_kept = is_tuned(spec) and not spec.not_kept
            tuned = self._store.find_tuned(spec) if is_kept else None
            if is_tuned(spec) and tuned is None:
                waiting.setdefault(tuning_key(spec), []).append(i)
            else:
                self._put("run", i, i, tuned)
        for positions in waiting.values():
            number = len(self._entries) + positions[0]
            self._waiting[number] = positions
            self._put("tune", number, positions[0], None)

    def next(self) -> list[tuple[int, RunResult]]:
        """Wait for one answer. Returns the runs that ended with it."""
        number, answer = self._executor.get()
        if number not in self._waiting:
            return [(number, self._result(number, answer))]
        waiting = self._waiting[number]
        if answer.tuned is None:
            return [(i, self._result(i, answer)) for i in waiting]
        if not self._entries[waiting[0]].spec.not_kept:
            self._store.keep_tuned(self._entries[waiting[0]].spec, answer.tuned)
        for i in waiting:
            self._put("run", i, i, answer.tuned)
        return []

    def _put(self, kind, number: int, i: int, tuned: dict | None) -> None:
        entry = self._entries[i]
        self._executor.put(
            number,
            Task(
                kind=kind,
                spec=entry.spec,
                backend=chosen(),
                rule=_own_rule(entry),
                sequence=entry.sequence,
                tuned=tuned,
                program=program_parts(),
            ),
        )

    def _result(self, i: int, answer: Answer) -> RunResult:
        for name, content in answer.pictures.items():
            write_file(self._store.folder / name, content)
        if answer.result is not None:
            return answer.result
        return RunResult(spec=self._entries[i].spec, status="failed", reason=answer.reason)


def _own_rule(entry: Entry) -> SeedingRule | None:
    """A rule that other processes do not know by its name, because it was defined in this one."""
    registered_rule = registered().get(entry.spec.rule)
    return (
        entry.rule
        if registered_rule is None or is_built_in(registered_rule) or entry.rule is not None
        else registered_rule
    )
