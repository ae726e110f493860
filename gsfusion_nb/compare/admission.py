"""Which entrants may take part: each rule that is not of this package is checked in a fresh
process, once."""

import contextlib
import hashlib
import logging
import os
import pickle
import subprocess
import sys
import tempfile
import types
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cloudpickle

from ..code_keys.key import differing, where_module
from ..code_keys.origin import is_library_module
from ..data.adjust.extra_files import ExtraFiles, ExtraSample, read_extra
from ..files import read_object, read_sealed, write_sealed
from ..seeding import SeedingRule, is_built_in, rule_name
from .fresh_check import CheckJob
from .map_scene import Entry
from .program import run_key
from .rule_variants import original
from .spec import ONLY_NOW

log = logging.getLogger(__name__)

AT_MOST_S = 300.0
"""How long the check of a rule may take, seconds; usually it takes 3 to 6."""
OTHER_ORDERS = ("2", "3", "4")
"""For further checks of a rule that has sets. Two texts have another order in one of them in seven
cases of eight."""


@dataclass(frozen=True, kw_only=True)
class Admission:
    """What the check of an entrant found."""

    refused: str = ""
    """Why it cannot take part; empty if it can."""
    not_kept: str = ""
    """Why its results cannot be kept for later; empty if they can."""


def admission(entry: Entry, folder: Path) -> Admission:
    """Check the rule of a run with its options, in a fresh process; what was found is kept in
    ``folder``.

    Args:
        entry: The run, with the code of its rule in its spec.
        folder: Where the findings are.
    """
    rule = original(entry.found_rule())
    if is_built_in(rule):
        return Admission()
    spec = entry.spec
    path = folder / f"{_check_key(entry)}.json"
    if not spec.not_kept and (stored := _read(path)) is not None:
        return stored
    report = _run(entry, rule)
    if report.get("walks_sets") and not report["refused"]:
        report = _run_in_other_orders(entry, rule, report)
    own_code = dict(spec.code or {})
    fresh_code = report["code"]
    differences = differing(
        *({"values": parts.get("values", "")} for parts in (own_code, fresh_code))
    )
    not_kept = ""
    if not report["refused"] and not spec.not_kept and differences:
        not_kept = f"{rule_name(rule)} is not the same in every process: its {differences} differ"
    result = Admission(refused=report["refused"], not_kept=not_kept)
    if not spec.not_kept and not report.get("lost"):
        write_sealed(path, vars(result))
    return result


def _read(path: Path) -> Admission | None:
    """What an earlier check found; None if nothing is known, or its file was changed or damaged,
    which is told."""
    if not path.is_file():
        return None
    try:
        return Admission(**read_sealed(path, "the check of a seeding rule"))
    except (ValueError, TypeError) as e:
        log.warning("%s is not used, and the rule is checked again: %s", path, e)
        return None


def _run_in_other_orders(
    entry: Entry,
    rule: SeedingRule,
    first: dict[str, Any],
) -> dict[str, Any]:
    """``first``, or why the rule is refused: in processes in which sets have other orders it gives
    other seeds."""
    with ThreadPoolExecutor(len(OTHER_ORDERS)) as pool:
        others = list(pool.map(lambda seed: _run(entry, rule, seed), OTHER_ORDERS))
    if failure := next((report for report in others if report["refused"]), None):
        return failure
    if all(report["seeds"] == first["seeds"] for report in others):
        return first
    why = (
        f"the seeding rule {entry.spec.rule_name!r} gives other seeds in another process: the "
        "order of the texts in a set differs from process to process, so sort it: sorted(names)"
    )
    return {**first, "refused": why}


def _check_key(entry: Entry) -> str:
    spec = entry.spec
    code = {name: digest for name, digest in (spec.code or {}).items() if name != ONLY_NOW}
    options = {name: str(value) for name, value in spec.options.items()}
    return run_key(
        check=spec.rule_name,
        code=code,
        options=options,
        extra=hashlib.sha256(_extra(entry)).hexdigest(),
    )


def _run(
    entry: Entry,
    rule: SeedingRule,
    order: str = "1",
) -> dict[str, Any]:
    """What ``fresh_check`` writes about a rule. ``order`` decides that of texts in sets
    (PYTHONHASHSEED)."""
    with tempfile.TemporaryDirectory(prefix="gsfusion-check-") as place:
        job = Path(place) / "job"
        spec = entry.spec
        try:
            job.write_bytes(_job(entry, rule))
        except Exception as e:  # whatever an object's own method raises
            return _refusal(
                f"the rule {spec.rule_name} cannot be sent to another process to be checked: {e}"
            )
        command = [sys.executable, "-m", f"{__package__}.fresh_check", str(job)]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            "PYTHONHASHSEED": order,
        }
        try:
            process = subprocess.run(
                command,
                env=environment,
                capture_output=True,
                text=True,
                timeout=AT_MOST_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return _refusal(
                f"the check of the rule {spec.rule_name} did not end within {AT_MOST_S:.0f} s"
            )
        answer = job.with_suffix(".json")
        if not answer.is_file():
            last = process.stderr.strip().splitlines()[-1:] or [f"exit status {process.returncode}"]
            return _refusal(
                f"the process that checks the rule {spec.rule_name} ended early: {last[0]}"
            )
        return read_object(answer, "the check of a seeding rule")


def _refusal(why: str) -> dict[str, Any]:
    return {"refused": why, "code": {}, "lost": True}


def _job(entry: Entry, rule: SeedingRule) -> bytes:
    spec = entry.spec
    fields: dict[str, Any] = {
        "name": rule_name(rule),
        "options": dict(spec.options),
        "extra": _extra(entry),
    }
    if entry.rule is None and spec.rule_source:
        file, _, name = spec.rule.rpartition(":")
        place = str(Path(spec.rule_folder) / Path(file).name) if spec.rule_folder else file
        fields |= {
            "name": name,
            "source": spec.rule_source,
            "file": place,
            "folder": spec.rule_folder,
        }
    else:
        fields["pickled"] = _pickle_bytes(rule)
    return pickle.dumps(CheckJob(**fields))


def _extra(entry: Entry) -> bytes:
    """The pickled function that gives the scenes of the check further images; where they come from
    files, those of the first frame stand for all."""
    has_files = "extra" in entry.spec.reader
    sequence = entry.opened() if has_files else entry.sequence
    if sequence is None:
        return b""
    extra = sequence.mapping.extra
    if isinstance(extra, ExtraFiles):
        first = extra.files(sequence.mapping.positions[:1])
        images = {name: read_extra(file) for name, file in zip(extra.patterns, first, strict=True)}
        extra = ExtraSample(images=images)
    return b"" if extra is None else _pickle_bytes(extra)


def _pickle_bytes(thing: Any) -> bytes:
    with _by_value(sys.modules.get(thing.__module__)):
        return cloudpickle.dumps(thing)


@contextlib.contextmanager
def _by_value(module: types.ModuleType | None) -> Iterator[None]:
    """Context in which what is in a module that another process cannot import is pickled by its
    content."""
    if module is None or module.__name__ == "__main__" or is_library_module(module):
        yield
        return
    spec = where_module(module.__name__, None)
    if spec is not None and spec.origin == getattr(module, "__file__", None):
        yield
        return
    cloudpickle.register_pickle_by_value(module)
    try:
        yield
    finally:
        cloudpickle.unregister_pickle_by_value(module)
