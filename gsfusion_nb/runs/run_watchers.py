"""What may look on while a run maps, such as a browser tab or a file for another program."""

from typing import Any, Protocol, runtime_checkable

from ..mapping import GlobalStep, StepReport
from ..types import Frame, Mesh


@runtime_checkable
class RunWatcher(Protocol):
    """Sees what a run maps, such as a file for another program; it changes nothing."""

    def frame_mapped(self, mapper: Any, frame: Frame, report: StepReport) -> None:
        """Called after each mapped frame, when the state is complete."""
        ...

    def finished(
        self,
        mapper: Any,
        mesh: Mesh,
        metrics: dict[str, Any],
    ) -> None:
        """Called once, when the maps are written and scored."""
        ...


@runtime_checkable
class PassWatcher(RunWatcher, Protocol):
    """Sees also the optimisation after the scan."""

    def optimised(self, mapper: Any, step: GlobalStep) -> None:
        """Called after each step, when the state is complete."""
        ...
