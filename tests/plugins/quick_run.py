"""The quick version of a chapter: the pieces of code that a cell's metadata names are replaced by
smaller ones."""

import copy
from typing import Any


def quick(notebook: dict[str, Any]) -> dict[str, Any]:
    """A copy of a notebook, as read from JSON, with fewer frames, seeds and steps."""
    small = copy.deepcopy(notebook)
    for cell in small["cells"]:
        for full, less in cell["metadata"].get("quick", {}).items():
            source = "".join(cell["source"])
            assert source.count(full) == 1, f"cell {cell['id']} must have {full!r} once"
            cell["source"] = source.replace(full, less)
    return small


def on_one_thread(notebook: dict[str, Any]) -> dict[str, Any]:
    """A copy of a notebook whose cell of settings lets torch use one thread, for a browser beside
    it."""
    changed = copy.deepcopy(notebook)
    settings = next(
        cell for cell in changed["cells"] if "parameters" in cell["metadata"].get("tags", [])
    )
    settings["source"] = "import torch; torch.set_num_threads(1)\n" + "".join(settings["source"])
    return changed
