"""Continue a run from its last checkpoint."""

from pathlib import Path
from typing import Any

import torch

from ..data import open_sequence
from ..export import CheckpointStore
from ..files import UNREADABLE, SequenceError, file_hashes, read_text, reason_of
from ..mapping import get_system
from ..seeding import SeedingRule
from ..seeding.rule_code import MOST_BYTES, is_rule_file, read_rule_file, rule_of_source
from .mapping_run import MappingRun
from .run_folder import CHECKPOINTS, RULE, holds_nothing, is_complete, load_random_state, read_status, unpacked
from .stream_run import StreamRun

MOST_NAMED = 3
"""Changed files that a message names."""


def load_run(
    folder: Path | str,
    *,
    seeding: "str | SeedingRule | None" = None,
    device: torch.device | str = "cpu",
    changed_data: bool = False,
    **given: Any,
) -> MappingRun:
    """The run that was interrupted or killed in ``folder``; a stream gives no more frames. ``given``: loss, optimiser.

    Raises:
        FileNotFoundError: The folder holds no checkpoint (a complete run leaves none).
        ValueError: All checkpoints are damaged, the run's sequence was in memory, or its files have changed and
            ``changed_data`` is not set.
    """
    path, store = Path(folder), CheckpointStore(Path(folder) / CHECKPOINTS)
    if not store.exists:
        raise FileNotFoundError(f"{store.folder} holds no checkpoint: {_why_none(path)}")
    loaded = store.load()
    try:
        run = _run_of(loaded.state, path, seeding, device, changed_data, given)
        load_random_state(loaded.state["random"])
    except SequenceError as e:
        if str(path) in str(e):
            raise
        raise SequenceError(f"{store.folder}: {e}") from e
    except Exception as e:  # the checkpoint is intact, but this version does not know its state
        raise ValueError(f"{store.folder} is damaged or from another version: {reason_of(e)}") from None
    run.use_store(path, store)
    run.warnings += [note for note in run.mapper.notes if note not in run.warnings]
    if loaded.passed_over:
        run.warnings.append(f"{loaded.passed_over}; checkpoint {loaded.number}, which is intact, is used instead")
    return run


def _why_none(path: Path) -> str:
    """Why the folder of a run holds no checkpoint, and what to do."""
    if is_complete(path):
        return "the run is complete, and there is nothing to continue"
    if holds_nothing(path):
        return "the run ended before its first one; map again into the same folder"
    return "the folder is not that of an interrupted run; map again into a new folder"


def _changes(then: dict[str, str], now: dict[str, str]) -> list[str]:
    """The files that differ between two states of a recording, with how: a path, and a word."""
    found = []
    for path in sorted(then | now):
        if path not in then:
            found.append(f"{path} (new)")
        elif path not in now or (now[path] == UNREADABLE and then[path] != UNREADABLE):
            found.append(f"{path} (deleted)")
        elif then[path] != now[path]:
            found.append(f"{path} (changed)")
    return found


def _in_words(changes: list[str], path: Path) -> str:
    more = f" and {len(changes) - MOST_NAMED} more" if len(changes) > MOST_NAMED else ""
    return f"files of the recording are not as they were when {path} began: {', '.join(changes[:MOST_NAMED])}{more}"


def _refuse(changes: list[str], path: Path) -> None:
    if changes:
        raise SequenceError(
            f"{_in_words(changes, path)}; restore them, or map again into a new folder (--changed-data goes on all the "
            "same, with a map of two data sets)"
        )


def _rule_of(path: Path, name: str, given: "str | SeedingRule | None") -> "str | SeedingRule | None":
    """The rule to continue with: that of the run's folder if it came from a file, else the given one, if any.

    Raises:
        SequenceError: a file is given whose content is not that in the run's folder.
    """
    if not read_status(path).get("rule_from_file") or not (path / RULE).is_file():
        return given
    stored = read_text(path / RULE, "the seeding rule of a run", at_most=MOST_BYTES)
    if given is None:
        return rule_of_source(stored, name, str(path / RULE))
    if isinstance(given, str) and is_rule_file(given) and read_rule_file(given) != (stored, name):
        raise SequenceError(
            f"{given} is not the seeding rule with which the run in {path} began: the run's own is in {path / RULE}; "
            "leave out the rule to continue with it, or map again with the new one"
        )
    return given


def _run_of(
    document: dict[str, Any],
    path: Path,
    seeding: "str | SeedingRule | None",
    device: torch.device | str,
    changed_data: bool,
    given: dict[str, Any],
) -> MappingRun:
    source, state = document["source"], document["run"]
    if not source:
        raise SequenceError(
            f"{path} was mapped from a sequence in memory; only runs on a sequence opened by path or name can resume"
        )
    rule = _rule_of(path, document["mapper"]["rule"]["name"], seeding)
    system = get_system(document["system"])
    mapper = system.from_state_dict(document["mapper"], seeding=rule, device=device, **given)
    if "stream" in source:
        return StreamRun.after_a_kill(source, mapper, state)
    then = unpacked(state["data_files"])
    if not changed_data:
        _refuse(_changes(then, file_hashes(then)), path)
    run = MappingRun(open_sequence(**source, data=mapper.config.data), mapper, source=source)
    changes = _changes(then, run.data_files)
    if not changed_data:
        _refuse(changes, path)
    run.load_state_dict(state)
    if changes:
        run.warnings.append(
            f"{_in_words(changes, path)}; it went on all the same, as asked, after {len(run.steps)} frames"
        )
    cameras = [run.mapper.localiser.camera, *(keyframe.camera for keyframe in run.mapper.keyframes)]
    others = [camera for camera in cameras if camera not in (None, run.sequence.camera)]
    if others:
        raise SequenceError(
            f"{path} was mapped with the camera {others[0]}, but {run.sequence.name} now has {run.sequence.camera}"
        )
    n = len(run.sequence.mapping)
    if run.next_position > n:
        raise SequenceError(
            f"{path} was interrupted after {run.next_position} frames, but {run.sequence.name} has {n} now; expected "
            "the files that the run started with"
        )
    return run
