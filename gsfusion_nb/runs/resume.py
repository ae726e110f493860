"""Continue a run from its last checkpoint."""

from pathlib import Path
from typing import Any

import torch

from ..data import open_sequence
from ..errors import SequenceError
from ..export import CheckpointStore
from ..foreign import reason_of
from ..mapping import get_system
from ..seeding import SeedingRule
from .mapping_run import MappingRun
from .random_state import load_random_state
from .run_folder import CHECKPOINTS
from .stream_run import StreamRun


def load_run(
    folder: Path | str, *, seeding: "str | SeedingRule | None" = None, device: torch.device | str = "cpu"
) -> MappingRun:
    """The run that was interrupted or killed in ``folder``; a stream gives no more frames.

    Raises:
        FileNotFoundError: The folder holds no checkpoint (a complete run leaves none).
        ValueError: All checkpoints are damaged, or the run's sequence was in memory.
    """
    path, store = Path(folder), CheckpointStore(Path(folder) / CHECKPOINTS)
    if not store.exists:
        raise FileNotFoundError(
            f"{store.folder} holds no checkpoint: the run completed, or was killed before its first one; in that "
            "case, map again into the same folder"
        )
    loaded = store.load()
    try:
        run = _run_of(loaded.state, path, seeding, device)
        load_random_state(loaded.state["random"])
    except SequenceError as e:
        if str(path) in str(e):
            raise
        raise SequenceError(f"{store.folder}: {e}") from e
    except Exception as e:  # the checkpoint is intact, but this version does not know its state
        raise ValueError(f"{store.folder} is damaged or from another version: {reason_of(e)}") from None
    run.use_store(path, store)
    run.warnings += run.mapper.notes
    if loaded.passed_over:
        run.warnings.append(f"{loaded.passed_over}; checkpoint {loaded.number}, which is intact, is used instead")
    return run


def _run_of(
    document: dict[str, Any], path: Path, seeding: "str | SeedingRule | None", device: torch.device | str
) -> MappingRun:
    source, state = document["source"], document["run"]
    if not source:
        raise SequenceError(
            f"{path} was mapped from a sequence in memory; only runs on a sequence opened by path or name can resume"
        )
    mapper = get_system(document["system"]).from_state_dict(document["mapper"], seeding=seeding, device=device)
    if "stream" in source:
        return StreamRun.after_a_kill(source, mapper, state)
    run = MappingRun(open_sequence(**source, data=mapper.config.data), mapper, source=source)
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
