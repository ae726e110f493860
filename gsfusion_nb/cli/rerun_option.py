"""The option --rerun: a run as a file for the Rerun viewer."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..viz.rerun_file import RerunFile


def rerun_file(path: str) -> "RerunFile":
    """Watches a run and writes the file ``path``; one that exists is replaced."""
    from ..viz.rerun_file import RerunFile

    return RerunFile(path)


def new_rerun_file(path: str, holds: str) -> "RerunFile":
    """As ``rerun_file``.

    Raises:
        FileExistsError: there is a file, which may hold what cannot be written again.
    """
    if Path(path).exists():
        raise FileExistsError(f"{path} exists and may hold {holds}; give --rerun the name of a new file")
    return rerun_file(path)
