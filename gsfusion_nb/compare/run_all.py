"""All runs of a comparison: what is known is reused, the rest is computed, and results come as they finish."""

import dataclasses
from collections.abc import Generator, Sequence

from ..backends import chosen
from ..files import write_file
from ..seeding import SeedingRule, is_built_in, registered
from .executors import Executor, InProcess
from .map_scene import Entry
from .result import RunResult
from .run_key import run_key
from .spec import data_seen_once
from .store import ResultStore, tuning_key
from .tasks import Answer, Task
from .tune import is_tuned


def run_all(
    entries: Sequence[Entry], store: ResultStore, executor: Executor | None = None, *, pictures: bool = True
) -> Generator[tuple[int, RunResult], None, None]:
    """Run all ``entries``; yields position and result of each when it is there, each result written to ``store``.

    The data are looked at anew. Results in ``store`` are reused, runs with equal keys are done once, and runs that
    differ only in their seed are tuned once. When the caller stops, everything that was yielded is kept.

    Args:
        entries: The runs.
        store: Where results are kept.
        executor: Where the runs are done; in this process by default.
        pictures: Make pictures of some held-out views.
    """
    entries = [dataclasses.replace(entry, spec=dataclasses.replace(entry.spec)) for entry in entries]
    positions: dict[str, list[int]] = {}
    known: dict[int, RunResult] = {}
    plan = _Plan(entries, store, executor or InProcess(), pictures)
    with data_seen_once():
        for i, entry in enumerate(entries):
            found = store.find(entry.spec)
            if found is not None:
                known[i] = found
            else:
                positions.setdefault(entry.spec.key, []).append(i)
        left = {same[0]: same for same in positions.values()}
        plan.begin(list(left))
    yield from known.items()
    while left:
        for i, result in plan.next():
            store.keep(result)
            yield from ((k, dataclasses.replace(result, spec=entries[k].spec)) for k in left.pop(i))


class _Plan:
    """Tuning first; then the runs that waited for it."""

    def __init__(self, entries: Sequence[Entry], store: ResultStore, executor: Executor, pictures: bool):
        self._entries, self._store, self._executor, self._pictures = entries, store, executor, pictures
        self._waiting: dict[str, list[int]] = {}
        self._tuning: dict[int, str] = {}

    def begin(self, runs: list[int]) -> None:
        """Put the runs, by position, or the tunings that they need."""
        for i in runs:
            spec = self._entries[i].spec
            tuned = self._store.find_tuned(spec) if is_tuned(spec) else None
            if is_tuned(spec) and tuned is None:
                self._waiting.setdefault(tuning_key(spec), []).append(i)
            else:
                self._put("run", i, i, tuned)
        for n, (key, waiting) in enumerate(self._waiting.items()):
            self._tuning[-1 - n] = key
            self._put("tune", -1 - n, waiting[0], None)

    def next(self) -> list[tuple[int, RunResult]]:
        """Wait for one answer. Returns the runs that ended with it."""
        number, answer = self._executor.get()
        if number not in self._tuning:
            return [(number, self._result(number, answer))]
        waiting = self._waiting[self._tuning[number]]
        if answer.tuned is None:
            return [(i, self._result(i, answer)) for i in waiting]
        self._store.keep_tuned(self._entries[waiting[0]].spec, answer.tuned)
        for i in waiting:
            self._put("run", i, i, answer.tuned)
        return []

    def _put(self, kind, number: int, i: int, tuned: dict | None) -> None:
        entry = self._entries[i]
        self._executor.put(
            number,
            Task(kind=kind, spec=entry.spec, backend=chosen(), rule=_own_rule(entry), sequence=entry.sequence,
                 tuned=tuned, with_pictures=self._pictures, program=run_key()),
        )  # fmt: skip

    def _result(self, i: int, answer: Answer) -> RunResult:
        for name, content in answer.pictures.items():
            write_file(self._store.folder / name, content)
        if answer.result is not None:
            return answer.result
        return RunResult(spec=self._entries[i].spec, status="failed", reason=answer.reason)


def _own_rule(entry: Entry) -> SeedingRule | None:
    """A rule that other processes do not know by its name, because it was defined in this one."""
    known = registered().get(entry.spec.rule)
    return entry.rule if known is None or is_built_in(known) or entry.rule is not None else known
