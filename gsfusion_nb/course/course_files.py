"""Where the notebooks of the installed version are, and a learner's copies of them in any folder."""

from pathlib import Path

from .course_pages import docs_folder, pages
from .edition import HandedOut, hand_out

FIRST = "00_quickstart.ipynb"


def notebooks_folder() -> Path:
    """The folder of the solved notebooks: in an installed package, or in a clone.

    Raises:
        FileNotFoundError: this installation has none.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "notebooks", package.parent / "notebooks"):
        if (folder / FIRST).is_file():
            return folder
    raise FileNotFoundError(f"{package} holds no notebooks; expected {FIRST} in its folder notebooks: install it again")


def copy_for_learner(target: Path) -> list[HandedOut]:
    """The learner's edition of the installed notebooks in the folder ``target``; what was changed there is kept.

    The pages of the documentation come along, unless ``target`` is a folder of a clone, whose own pages links lead to.

    Raises:
        NotADirectoryError: ``target`` is a file. FileNotFoundError: this installation has no notebooks.
    """
    if target.exists() and not target.is_dir():
        raise NotADirectoryError(f"{target} is a file; expected a folder for the notebooks")
    docs, notebooks = docs_folder(), notebooks_folder()
    in_clone = docs is not None and target.resolve().parent == docs.parent == notebooks.parent
    return hand_out(notebooks, target, None if in_clone or docs is None else pages(docs))
