"""What a checkpoint of a run holds, and writing it."""

from pathlib import Path
from typing import Any

from ..export import CheckpointStore
from ..seeding.code_files import file_source
from .mapping_run import MappingRun
from .ran_on import ran_on
from .run_folder import CHECKPOINTS, random_state
from .system_of_run import about_system, code_of_system


def document_of(run: MappingRun) -> dict[str, Any]:
    """All that a checkpoint of the run holds."""
    return {
        **about_system(run.mapper),
        "system_code": code_of_system(run.mapper),
        "run": run.state_dict(),
        "source": run.source or run.stream(),
        "mapper": run.mapper.state_dict(copies=False),
        "rule_from_file": bool(file_source(run.mapper.rule)),
        "ran_on": ran_on(run.mapper.device),
        "random": random_state(),
    }


def save_checkpoint(run: MappingRun, folder: Path) -> None:
    """Write a checkpoint to ``folder``, from which the run can be resumed; only what has changed is
    written."""
    document = document_of(run)
    if run.store is None or run.store.folder != folder / CHECKPOINTS:
        run.store = CheckpointStore(folder / CHECKPOINTS)
    run.store.save(document, constant=run.constant_tensors())
