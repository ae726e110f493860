"""Opening a sequence by path or name, whatever its layout."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..checks import check_name
from ..config import DataConfig
from .adjust.select import OpenedSequence, apply_options
from .readers.folder import LOOKS_FOR as FOLDER_FILES
from .readers.folder import folder
from .readers.replica import LOOKS_FOR as REPLICA_FILES
from .readers.replica import replica
from .readers.scannetpp import LOOKS_FOR as SCANNETPP_FILES
from .readers.scannetpp import scannetpp, scene_folder
from .readers.seven_scenes import LOOKS_FOR as SEVEN_SCENES_FILES
from .readers.seven_scenes import first_sequence, seven_scenes
from .readers.tum import LOOKS_FOR as TUM_FILES
from .readers.tum import tum
from .recorded.find_files import missing
from .sequence import Sequence, SequenceError, SequenceNotFoundError


@dataclass(frozen=True)
class Layout:
    """One way to lay out a sequence on disk."""

    read: Callable[..., Sequence]
    looks_for: tuple[str, ...]
    locate: Callable[[Path], Path] = lambda path: path
    """Folder below the given one where the parts are looked for."""
    has_splits: bool = False


LAYOUTS: dict[str, Layout] = {
    "folder": Layout(folder, FOLDER_FILES),
    "replica": Layout(replica, REPLICA_FILES),
    "tum": Layout(tum, TUM_FILES),
    "scannetpp": Layout(scannetpp, SCANNETPP_FILES, scene_folder, True),
    "seven_scenes": Layout(seven_scenes, SEVEN_SCENES_FILES, first_sequence),
}
"""Layouts by name, in the order in which they are tried."""


def open_sequence(
    path_or_name: str | Path,
    *,
    format: str = "auto",
    data: DataConfig | None = None,
    split: str | None = None,
    **options: Any,
) -> OpenedSequence:
    """Open a sequence: what is to be mapped is ``.mapping``, what is held out for evaluation is ``.held_out``.

    Args:
        path_or_name: Folder of a sequence, or "room", the built-in scene (a folder of that name: "./room").
        format: "auto" recognises the layout by its files; or the name of one: ``layouts()``.
        data: Size, range, depth limits, held-out frames.
        split: "train" or "test" of a data set that publishes such lists (ScanNet++); None maps the training frames and
            holds the test frames out.
        options: Keyword arguments of the layout's reader, such as ``undistort`` of ``tum`` or ``register`` of
            ``seven_scenes``.

    Raises:
        SequenceNotFoundError: no such folder, or one of its files is missing.
        SequenceError: the folder fits no layout (the message lists what was looked for), or its content makes no sense.
        KeyError: unknown format.
    """
    check_name("format", format, ("auto", "room", *LAYOUTS))
    if format == "room" or (format == "auto" and str(path_or_name) == "room"):
        if split is not None:
            raise SequenceError(
                f"the built-in scene has no split {split!r}; held-out views come from data.hold_out_every"
            )
        from .room import room

        if data is not None and data.width and data.height:  # rendered at the wanted size, not resized to it
            options = {"width": data.width, "height": data.height, **options}
        source: Any = room(**options)
        return apply_options(source, data)
    path = Path(path_or_name).expanduser()
    if not path.is_dir():
        raise SequenceNotFoundError(
            f"{path} is no folder; expected one that holds a sequence, or the name of a built-in: room"
        )
    name = detect_layout(path) if format == "auto" else format
    layout = LAYOUTS[name]
    if split is not None:
        if not layout.has_splits:
            raise SequenceError(
                f"{path}: the {name!r} layout has no split {split!r}; use data.hold_out_every to hold frames out"
            )
        options = {"split": split, **options}
    return apply_options(layout.read(path, **options), data)


def layouts() -> list[str]:
    """Names that ``open_sequence(format=...)`` takes besides "auto" and "room"."""
    return list(LAYOUTS)


def detect_layout(path: str | Path) -> str:
    """Name of the first layout all of whose files are there.

    Raises:
        SequenceError: none; lists for each layout what was looked for and what is missing.
    """
    path = Path(path)
    lacking = {name: missing(layout.locate(path), layout.looks_for) for name, layout in LAYOUTS.items()}
    for name, parts in lacking.items():
        if not parts:
            return name
    nearest = sorted(LAYOUTS, key=lambda name: len(lacking[name]) / len(LAYOUTS[name].looks_for))
    described = "; ".join(f"{n}: {', '.join(LAYOUTS[n].looks_for)} (missing {', '.join(lacking[n])})" for n in nearest)
    raise SequenceError(f"{path} fits no known layout; looked for {described}")
