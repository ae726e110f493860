"""Continue a run from its last checkpoint."""

import shlex
from pathlib import Path
from typing import Any

import torch

from ..data import open_sequence
from ..errors import ArgumentError, SequenceError, reason_of
from ..export import CheckpointStore
from ..files import UNREADABLE, file_hashes
from ..mapping import Mapper
from ..seeding import SeedingRule, rule_name
from ..seeding.code_files import (
    code_folder,
    file_of,
    file_source,
    is_code_file,
    read_code_file,
)
from ..seeding.named_code import RuleNotNamedError, is_named
from ..seeding.rule_code import rule_of_source
from .checkpoint import document_of
from .mapping_run import MappingRun
from .ran_on import difference, ran_on
from .run_folder import (
    CHECKPOINTS,
    RULE,
    SYSTEM,
    is_complete,
    load_random_state,
    random_state,
    unpacked,
)
from .sound_state import check_names, check_same, check_values
from .state_agreement import check_agreement
from .stream_run import StreamRun
from .system_of_run import refuse_other_system, system_of_run


def load_run(
    folder: Path | str,
    *,
    seeding: "str | SeedingRule | None" = None,
    system: str | type[Mapper] | None = None,
    device: torch.device | str = "cpu",
    **given: Any,
) -> MappingRun:
    """The run that was interrupted or killed in ``folder``; a stream gives no more frames.
    ``given``: loss, optimiser.

    No code from the folder is executed, unless ``seeding`` or ``system`` names it.

    Raises:
        CodeNotNamedError: The run's seeding rule or its system came from a file, and ``seeding`` or
            ``system`` names none.
        FileNotFoundError: The folder holds no checkpoint (a complete run leaves none).
        ValueError: All checkpoints are damaged, the run's sequence was in memory, or its files have
            changed.
    """
    path = Path(folder)
    store = CheckpointStore(Path(folder) / CHECKPOINTS)
    if not store.exists:
        why = (
            "the run is complete, and there is nothing to continue"
            if is_complete(path)
            else "map again"
        )
        raise FileNotFoundError(f"{store.folder} holds no checkpoint: {why}")
    checkpoint = store.load()
    try:
        check_values({name: checkpoint.state[name] for name in ("run", "mapper")})
        check_names(checkpoint.state.get("ran_on"), "ran_on")
        check_values(_reports(checkpoint.state["run"]), ("run", "steps"))
        run = _run_of(checkpoint.state, path, seeding, system, device, given)
        load_random_state(checkpoint.state["random"])
        check_same(
            checkpoint.state["random"],
            random_state() | {"torch_cuda": checkpoint.state["random"]["torch_cuda"]},
        )
        kept = {name: checkpoint.state[name] for name in _KEPT if name in checkpoint.state}
        check_same(kept, document_of(run))
        check_agreement(run)
        run.warnings += [note for note in run.mapper.notes if note not in run.warnings]
    except SequenceError as e:
        if str(path) in str(e):
            raise
        raise SequenceError(f"{store.folder}: {e}") from e
    except Exception as e:  # the checkpoint is intact, but this version does not know its state
        raise ArgumentError(
            f"{store.folder} is damaged or from another version: {reason_of(e)}"
        ) from None
    run.store = store
    if sentence := _other_program(checkpoint.state.get("ran_on"), run):
        run.warnings.warn_once(sentence)
    run.warnings += [sentence for sentence in checkpoint.copies if sentence not in run.warnings]
    if checkpoint.passed_over:
        run.warnings.append(
            f"{checkpoint.passed_over}; checkpoint {checkpoint.number}, which is intact, is used "
            "instead"
        )
    return run


_KEPT = ("system", "system_from_file", "drawn_over_volume", "run", "mapper", "rule_from_file")
"""Parts of a checkpoint that a run does not change by going on from them."""


def _reports(state: dict[str, Any]) -> list[Any]:
    """The reports of frames in a state, as plain values."""
    return [
        row
        for block in (*state["steps"]["blocks"], state["steps"]["rest"])
        for row in unpacked(block)
    ]


def resume_command(folder: Path, mapper: Mapper) -> str:
    """What to type to continue the run in ``folder``; the files of its rule and its system are
    named, so that they may be executed."""
    rule = mapper.rule
    system = type(mapper)
    words = ["gsfusion-nb", "map", "--resume", str(folder)]
    if file_source(rule):
        words += ["--seeding.rule", f"{folder / RULE}:{rule_name(rule)}"]
    if file_source(system):
        words += ["--system", f"{folder / SYSTEM}:{system.__name__}"]
    return shlex.join(words)


def _other_program(stored: dict[str, str] | None, run: MappingRun) -> str:
    """A sentence if the run goes on with another backend or version than it was interrupted with;
    else empty."""
    where = f"after {len(run.steps)} frames and {run.mapper.passes.done} passes the run continued"
    if stored is None:
        return (
            f"{where} from a checkpoint that does not say with which versions and backend it "
            "was made"
        )
    changes = difference(stored, ran_on(run.mapper.device))
    return (
        changes
        and f"{where} with {changes}: its maps are not, bit for bit, those of a run without "
        "interruption"
    )


def _refuse_changes(
    stored_hashes: dict[str, str],
    current_hashes: dict[str, str],
    path: Path,
) -> None:
    """Raise ``SequenceError`` with the first files that differ between two states of a
    recording."""
    changes = []
    for file in sorted(stored_hashes | current_hashes):
        if file not in stored_hashes:
            changes.append(f"{file} (new)")
        elif file not in current_hashes or (
            current_hashes[file] == UNREADABLE and stored_hashes[file] != UNREADABLE
        ):
            changes.append(f"{file} (deleted)")
        elif stored_hashes[file] != current_hashes[file]:
            changes.append(f"{file} (changed)")
    if changes:
        more = f" and {len(changes) - 3} more" if len(changes) > 3 else ""
        raise SequenceError(
            f"files of the recording are not as they were when {path} began: "
            f"{', '.join(changes[:3])}{more}; restore them, or map again into a new folder"
        )


def _rule_of(
    path: Path,
    document: dict[str, Any],
    seeding: "str | SeedingRule | None",
    mapper_type: type[Mapper],
) -> "str | SeedingRule | None":
    """The rule to continue with. Code in the run's folder is somebody else's until the caller names
    it; a rule in the file of the system was named with that.

    Raises:
        RuleNotNamedError: the run's rule came from a file, and none is given.
        SequenceError: a file is given whose content is not that in the run's folder.
    """
    if not document["rule_from_file"]:
        return seeding
    own = path / RULE
    name = document["mapper"]["rule"]["name"]
    own_rule, _ = read_code_file(f"{own}:{name}")
    if seeding is None and own_rule == file_source(mapper_type):
        return rule_of_source(own_rule, name, *file_of(mapper_type))
    if seeding is None:
        rule = f"{own}:{name}"
        raise RuleNotNamedError(path, [rule], f"resume_mapping({str(path)!r}, seeding={rule!r})")
    if not (isinstance(seeding, str) and is_code_file(seeding)):
        return seeding
    if read_code_file(seeding) != (own_rule, name):
        raise SequenceError(
            f"{seeding} is not the seeding rule with which the run in {path} began: the run's "
            f"own is {own}:{name}; name that one to continue, or map again with the new one"
        )
    return rule_of_source(own_rule, name, seeding.rpartition(":")[0], code_folder(seeding))


def _is_own(path: Path, seeding: "str | SeedingRule | None") -> bool:
    """The rule is to be the one that the run began with: none is given, or the one in its
    folder."""
    if seeding is None:
        return True
    return (
        isinstance(seeding, str)
        and is_code_file(seeding)
        and is_named(seeding.rpartition(":")[0], [path / RULE])
    )


def _run_of(
    document: dict[str, Any],
    path: Path,
    seeding: "str | SeedingRule | None",
    system: str | type[Mapper] | None,
    device: torch.device | str,
    mapper_options: dict[str, Any],
) -> MappingRun:
    source = document["source"]
    state = document["run"]
    if not source:
        raise SequenceError(
            f"{path} was mapped from a sequence in memory; only runs on a sequence opened by path "
            "or name can resume"
        )
    mapper_type = system_of_run(
        path, document, system, lambda own: f"resume_mapping({str(path)!r}, system={own!r})"
    )
    rule = _rule_of(path, document, seeding, mapper_type)
    mapper = mapper_type.from_state_dict(
        document["mapper"], seeding=rule, device=device, **mapper_options
    )
    check_names(document.get("system_code"), "system_code")
    refuse_other_system(path, mapper, document.get("system_code") or {})
    changes = mapper.rule_in_use.difference(document["mapper"]["rule"])
    if changes and _is_own(path, seeding):
        raise SequenceError(
            f"the seeding rule is not as it was when {path} began; different: {changes}. Restore "
            "it, or continue with "
            "the rule as it is now by giving it (seeding.rule), in a file outside of that folder"
        )
    if "stream" in source:
        return StreamRun.after_a_kill(source, mapper, state)
    stored_hashes = unpacked(state["data_files"])
    _refuse_changes(stored_hashes, file_hashes(stored_hashes), path)
    run = MappingRun(open_sequence(**source, data=mapper.config.data), mapper, source=source)
    _refuse_changes(stored_hashes, run.data_files, path)
    run.load_state_dict(state)
    cameras = [
        run.mapper.localiser.memory.camera,
        *(keyframe.camera for keyframe in run.mapper.keyframes if keyframe.index >= 0),
    ]
    others = [camera for camera in cameras if camera not in (None, run.sequence.camera)]
    if others:
        raise SequenceError(
            f"{path} was mapped with the camera {others[0]}, but {run.sequence.name} now has "
            f"{run.sequence.camera}"
        )
    n = len(run.sequence.mapping)
    if run.next_position > n:
        raise SequenceError(
            f"{path} was interrupted after {run.next_position} frames, but {run.sequence.name} has "
            f"{n} now; expected the files that the run started with"
        )
    return run
