"""A plug-in of Otter-Grader that marks in the sandbox. The exported notebooks name it in their configuration."""

from pathlib import Path
from typing import Any

from nbformat.v4 import new_notebook
from otter.plugins import AbstractOtterPlugin

from ..exercise import exercises
from .marking import sentence, verdicts, warn
from .sandbox import Limits
from .submission import read_code


class MarkInSandbox(AbstractOtterPlugin):
    """Otter executes an empty notebook; the scores and messages of all questions come from the sandbox."""

    def before_execution(self, submission: Any) -> Any:
        """Nothing of the submission is executed by Otter."""
        return new_notebook()

    def after_grading(self, results: Any) -> None:
        """Put the marks in place of those of the empty notebook."""
        code = read_code(Path(self.submission_path))
        wanted = {name: code.cells for name in exercises() if name in results.results}
        warn()
        settings = self.plugin_config
        limits = Limits(seconds=float(settings["seconds"]), memory_mb=int(settings["memory_mb"]))
        for name, verdict in verdicts(wanted, int(settings["seed"]), limits).items():
            question = results.results[name]
            message = code.problem or sentence(verdict)
            for case in question.test_case_results:
                case.passed, case.message = bool(verdict), None if verdict else message
            question.update_score(question.possible if verdict else 0)
