"""The pieces of work of a comparison, as every executor does them: tuning, and scored runs."""

import contextlib
import dataclasses
import pickle
import tempfile
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ..backends import use_backend
from ..seeding import SeedingRule, rule_name
from .map_scene import Entry, finished
from .one_run import OnStep, run_entry
from .result import RunResult
from .run_key import run_key
from .spec import RunSpec
from .tune import tune, tuning_spec

_ONE_AT_A_TIME = threading.Lock()
"""Two runs in one process would share its threads, and each would be charged for the other's time and memory."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """One piece of work; it can be sent to another process."""

    kind: Literal["tune", "run"]
    spec: RunSpec
    backend: str
    """Backend that is in use where the comparison was started."""
    rule: SeedingRule | bytes | None = None
    """A rule that was defined in this process; as bytes on the way to another one."""
    sequence: Any = None
    """Frames that the caller has opened; they cannot be sent."""
    tuned: dict[str, Any] | None = None
    """Result of the tuning, for a run."""
    with_pictures: bool = True
    """Whether pictures of some held-out views are made."""
    program: str = ""
    """``run_key()`` where the comparison was started; empty asks for nothing."""

    def packed(self) -> "Task":
        """The task as it is sent to another process.

        Raises:
            ValueError: its frames are in memory, or its rule cannot be sent.
        """
        if self.sequence is not None:
            raise ValueError(
                f"{self.spec.scene} was opened in this process: give its name or folder, or use one process"
            )
        return self if self.rule is None else dataclasses.replace(self, rule=_pickled(self.rule))


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What a task gave."""

    result: RunResult | None = None
    """Of a run."""
    tuned: dict[str, Any] | None = None
    """Of a tuning."""
    reason: str = ""
    """Why there is neither."""
    pictures: dict[str, bytes] = field(default_factory=dict)
    """Content of the picture files of a run, by name."""


def do_task(task: Task, on_step: OnStep = lambda report: None) -> Answer:
    """Do a piece of work. Raises nothing; a failure is in the answer.

    ``on_step`` is called after each frame, and after other pieces of work with None.
    """
    with _ONE_AT_A_TIME, use_backend(task.backend):
        try:
            if task.program not in ("", run_key()):
                raise ValueError(
                    "this process has another version of gsfusion_nb, or of a library, than the comparison"
                )
            rule = pickle.loads(task.rule) if isinstance(task.rule, bytes) else task.rule
            entry = Entry(spec=task.spec, rule=rule, sequence=task.sequence)
            return _tune(entry, on_step) if task.kind == "tune" else _run(entry, task, on_step)
        except Exception as e:  # a user's rule may raise anything
            return Answer(reason=f"{type(e).__name__}: {e}")


def _tune(entry: Entry, on_step: OnStep) -> Answer:
    return Answer(tuned=finished(tune(dataclasses.replace(entry, spec=tuning_spec(entry.spec))), on_step))


def _run(entry: Entry, task: Task, on_step: OnStep) -> Answer:
    if not task.with_pictures:
        return Answer(result=run_entry(entry, None, task.tuned, on_step))
    with tempfile.TemporaryDirectory(prefix="gsfusion-lab-") as folder:
        result = run_entry(entry, Path(folder), task.tuned, on_step)
        pictures = {name: (Path(folder) / name).read_bytes() for name in result.pictures.values()}
    return Answer(result=result, pictures=pictures)


def _pickled(rule: SeedingRule | bytes) -> bytes:
    """A rule for another process; one of a notebook needs cloudpickle, which comes with Dask."""
    pickler: Any = pickle
    with contextlib.suppress(ImportError):
        import cloudpickle as pickler
    try:
        return pickler.dumps(rule)
    except (pickle.PicklingError, AttributeError, TypeError) as e:
        raise ValueError(
            f"the rule {rule_name(rule)} cannot be sent to other processes: {e}; write it to a file and give "  # pyright: ignore
            '"FILE.py:name", or install the extra "cluster"'
        ) from None
