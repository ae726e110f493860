"""The foreign formats that can be converted, one file each, and which one a file or folder has."""

from pathlib import Path

from ....data.sequence import SequenceError, SequenceNotFoundError
from . import colmap, icl_nuim, images, nerfstudio, open3d_log, record3d, ros_bag, scannet, tum

FORMATS = {
    "ros": ros_bag, "scannet": scannet, "record3d": record3d, "nerfstudio": nerfstudio, "icl_nuim": icl_nuim,
    "colmap": colmap, "open3d": open3d_log, "tum": tum, "images": images,
}  # fmt: skip
"""Formats by name, in the order in which they are tried. The module of a format has ``recognise(path)``,
``read(path, options)``, and ``LOOKS_FOR``, which says what identifies it."""


def known_formats() -> dict[str, str]:
    """Names that ``convert(format=...)`` takes besides "auto", each with what it looks for."""
    return {name: module.LOOKS_FOR for name, module in FORMATS.items()}


def detect_format(path: Path) -> str:
    """Name of the first format that ``path`` looks like.

    Raises:
        SequenceError: nothing is there, or no format fits; the message lists what each format looks for.
    """
    if not path.exists():
        raise SequenceNotFoundError(f"{path} does not exist; expected the file or folder of a recording")
    name = next((name for name, f in FORMATS.items() if f.recognise(path)), None)
    if name is None:
        described = "; ".join(f"{name}: {looks_for}" for name, looks_for in known_formats().items())
        raise SequenceError(f"{path} is in no known format; looked for {described}")
    return name
