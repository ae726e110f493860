"""The foreign formats that can be converted, one file each, and which one a file or folder has."""

from pathlib import Path

from ....data.open import detect_layout
from ....data.readers.seven_scenes import calibrated_folders
from ....data.readers.tum import benchmark_camera
from ....data.recorded.files import calibration_in
from ....errors import SequenceError, SequenceNotFoundError
from ....files import read_object
from . import (
    bop,
    colmap,
    icl_nuim,
    images,
    nerfstudio,
    neural_rgbd,
    open3d_log,
    polycam,
    record3d,
    ros_bag,
    scanner_app,
    scannet,
    sun3d,
    tartanair,
    tum,
)
from .unread import unread_recording

FORMATS = {
    "ros": ros_bag,
    "scannet": scannet,
    "record3d": record3d,
    "nerfstudio": nerfstudio,
    "polycam": polycam,
    "scanner_app": scanner_app,
    "icl_nuim": icl_nuim,
    "colmap": colmap,
    "sun3d": sun3d,
    "tartanair": tartanair,
    "neural_rgbd": neural_rgbd,
    "bop": bop,
    "open3d": open3d_log,
    "tum": tum,
    "images": images,
}
"""Formats by name, in the order in which they are tried. The module of a format has
``recognise(path)``, ``read(path, options)``, and ``LOOKS_FOR``, which says what identifies it."""


def known_formats() -> dict[str, str]:
    """Names that ``convert(format=...)`` takes besides "auto", each with what it looks for."""
    return {name: module.LOOKS_FOR for name, module in FORMATS.items()}


def readable_layout(path: Path) -> str:
    """Layout in which a folder can be opened as it is; empty where it must be converted first.

    That is so for lists and images as the TUM benchmark and 7-Scenes have them, but of another
    camera, and for a plain folder without the unit of its depth.
    """
    try:
        layout = detect_layout(path) if path.is_dir() else ""
    except SequenceError:
        return ""
    if layout == "folder" and "depth_scale" not in read_object(
        path / "intrinsics.json", "the camera's intrinsics"
    ):
        return ""
    if layout == "seven_scenes" and calibration_in(*calibrated_folders(path)) is not None:
        return ""
    return "" if layout == "tum" and not benchmark_camera(path) else layout


def detect_format(path: Path) -> str:
    """Name of the first format that ``path`` looks like.

    Raises:
        SequenceError: nothing is there, or no format fits; the message lists what each format looks
            for.
    """
    if not path.exists():
        raise SequenceNotFoundError(
            f"{path} does not exist; expected the file or folder of a recording"
        )
    name = next(
        (name for name, f in FORMATS.items() if f.recognise(path)),
        None,
    )
    if name in (None, "images") and (advice := unread_recording(path)):
        raise SequenceError(advice)
    if name is None:
        formats_text = "; ".join(
            f"{name}: {looks_for}" for name, looks_for in known_formats().items()
        )
        raise SequenceError(f"{path} is in no known format; looked for {formats_text}")
    return name
