"""Continue a run from its last checkpoint."""

from pathlib import Path
from typing import Any

import torch

from ..data import open_sequence
from ..export import CheckpointStore
from ..files import UNREADABLE, SequenceError, file_hashes, read_text, reason_of
from ..mapping import get_system
from ..seeding import SeedingRule
from ..seeding.rule_code import MOST_BYTES, RULE_MODULES, is_rule_file, read_rule_file, rule_of_source
from .mapping_run import MappingRun
from .run_folder import CHECKPOINTS, RULE, is_complete, load_random_state, unpacked
from .stream_run import StreamRun


def load_run(
    folder: Path | str, *, seeding: "str | SeedingRule | None" = None, device: torch.device | str = "cpu", **given: Any
) -> MappingRun:
    """The run that was interrupted or killed in ``folder``; a stream gives no more frames. ``given``: loss, optimiser.

    Raises:
        FileNotFoundError: The folder holds no checkpoint (a complete run leaves none).
        ValueError: All checkpoints are damaged, the run's sequence was in memory, or its files have changed.
    """
    path, store = Path(folder), CheckpointStore(Path(folder) / CHECKPOINTS)
    if not store.exists:
        why = "the run is complete, and there is nothing to continue" if is_complete(path) else "map again"
        raise FileNotFoundError(f"{store.folder} holds no checkpoint: {why}")
    loaded = store.load()
    try:
        run = _run_of(loaded.state, path, seeding, device, given)
        load_random_state(loaded.state["random"])
    except SequenceError as e:
        if str(path) in str(e):
            raise
        raise SequenceError(f"{store.folder}: {e}") from e
    except Exception as e:  # the checkpoint is intact, but this version does not know its state
        raise ValueError(f"{store.folder} is damaged or from another version: {reason_of(e)}") from None
    run.store = store
    run.warnings += [note for note in run.mapper.notes if note not in run.warnings]
    if loaded.passed_over:
        run.warnings.append(f"{loaded.passed_over}; checkpoint {loaded.number}, which is intact, is used instead")
    return run


def _refuse_changes(then: dict[str, str], now: dict[str, str], path: Path) -> None:
    """Raise ``SequenceError`` with the first files that differ between two states of a recording."""
    changes = []
    for file in sorted(then | now):
        if file not in then:
            changes.append(f"{file} (new)")
        elif file not in now or (now[file] == UNREADABLE and then[file] != UNREADABLE):
            changes.append(f"{file} (deleted)")
        elif then[file] != now[file]:
            changes.append(f"{file} (changed)")
    if changes:
        more = f" and {len(changes) - 3} more" if len(changes) > 3 else ""
        raise SequenceError(
            f"files of the recording are not as they were when {path} began: {', '.join(changes[:3])}{more}; restore "
            "them, or map again into a new folder"
        )


def _rule_of(path: Path, document: dict[str, Any], given: "str | SeedingRule | None") -> "str | SeedingRule | None":
    """The rule to continue with: that of the run's folder if it came from a file, else the given one, if any.

    Raises:
        SequenceError: a file is given whose content is not that in the run's folder.
    """
    if not document["rule_from_file"]:
        return given
    name = document["mapper"]["rule"]["name"]
    stored = read_text(path / RULE, "the seeding rule of a run", at_most=MOST_BYTES)
    if given is None:
        return rule_of_source(stored, name, str(path / RULE), path / RULE_MODULES)
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
    given: dict[str, Any],
) -> MappingRun:
    source, state = document["source"], document["run"]
    if not source:
        raise SequenceError(
            f"{path} was mapped from a sequence in memory; only runs on a sequence opened by path or name can resume"
        )
    rule, system = _rule_of(path, document, seeding), get_system(document["system"])
    mapper = system.from_state_dict(document["mapper"], seeding=rule, device=device, **given)
    changes = mapper.rule_in_use.difference(document["mapper"]["rule"])
    if seeding is None and changes:
        raise SequenceError(
            f"the seeding rule is not as it was when {path} began; different: {changes}. Restore it, or continue with "
            "the rule as it is now by naming it (seeding.rule)"
        )
    if "stream" in source:
        return StreamRun.after_a_kill(source, mapper, state)
    then = unpacked(state["data_files"])
    _refuse_changes(then, file_hashes(then), path)
    run = MappingRun(open_sequence(**source, data=mapper.config.data), mapper, source=source)
    _refuse_changes(then, run.data_files, path)
    run.load_state_dict(state)
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
