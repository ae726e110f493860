"""In place of nbgrader's execution of a notebook: its marks from the sandbox. ``nbgrader_config.py`` names it."""

from typing import Any

from nbformat.notebooknode import NotebookNode
from nbformat.v4 import new_output
from nbgrader.preprocessors import NbGraderPreprocessor
from traitlets import Float, Integer

from ..exercise import exercises
from .marking import verdicts, warn, why
from .sandbox import Limits
from .sandbox_program import Cell

_PREFIX = "test-"


class MarkInSandbox(NbGraderPreprocessor):
    """Gives each test cell of an exported chapter the output that its mark follows from; runs nothing in a kernel."""

    seed = Integer(0, help="of the hidden inputs").tag(config=True)
    seconds = Float(30.0, help="of processor time, for each function").tag(config=True)
    memory_mb = Integer(1024, help="for each function").tag(config=True)

    def preprocess(self, nb: NotebookNode, resources: Any) -> tuple[NotebookNode, Any]:
        """Mark one submitted notebook."""
        tests = {_exercise(cell): cell for cell in nb.cells if _exercise(cell)}
        cells = [
            Cell(f"cell {number}", cell.source)
            for number, cell in enumerate(nb.cells, start=1)
            if cell.cell_type == "code" and not _exercise(cell)
        ]
        wanted = {name: cells for name in exercises() if name in tests}
        warn()
        limits = Limits(seconds=self.seconds, memory_mb=self.memory_mb)
        for name, verdict in verdicts(wanted, self.seed, limits).items():
            if verdict:
                output = new_output("stream", name="stdout", text=verdict.headline + "\n")
            else:
                prop, message = why(verdict)
                output = new_output("error", ename=prop, evalue=message, traceback=[verdict.headline, message])
            tests[name].outputs = [output]
        return nb, resources


def _exercise(cell: NotebookNode) -> str:
    """The exercise that a cell tests; "" for other cells."""
    about = cell.metadata.get("nbgrader", {})
    name = str(about.get("grade_id", "")).removeprefix(_PREFIX)
    return name if about.get("grade") and name in exercises() else ""
