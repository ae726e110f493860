"""The foreign formats that can be converted, one file each, and which one a file or folder has."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ....data.sequence import SequenceError, SequenceNotFoundError
from ..recording import ConvertOptions, Recording
from . import colmap, icl_nuim, nerfstudio, open3d_log, record3d, ros_bag, scannet, tum


@dataclass(frozen=True)
class Format:
    """One foreign format."""

    read: Callable[[Path, ConvertOptions], Recording]
    recognise: Callable[[Path], bool]
    looks_for: str
    """Description of the files that identify this format, for messages."""


FORMATS: dict[str, Format] = {
    "ros": Format(ros_bag.read, ros_bag.recognise, "a .bag or .mcap file, or a folder with metadata.yaml"),
    "scannet": Format(scannet.read, scannet.recognise, "a .sens file, or a folder with color/, depth/ and pose/"),
    "record3d": Format(record3d.read, record3d.recognise, "a .r3d file, or its unpacked folder, or the EXR export"),
    "nerfstudio": Format(nerfstudio.read, nerfstudio.recognise, "transforms.json"),
    "icl_nuim": Format(icl_nuim.read, icl_nuim.recognise, "a trajectory *.gt.freiburg, or *.depth files"),
    "colmap": Format(colmap.read, colmap.recognise, "cameras and images, .bin or .txt, also in sparse/0"),
    "open3d": Format(open3d_log.read, open3d_log.recognise, "trajectory.log or .json, color/ and depth/"),
    "tum": Format(tum.read, tum.recognise, "rgb.txt and depth.txt, associations.txt, or rgb/ and depth/"),
}
"""Formats by name, in the order in which they are tried."""


def known_formats() -> dict[str, str]:
    """Names that ``convert(format=...)`` takes besides "auto", each with what it looks for."""
    return {name: f.looks_for for name, f in FORMATS.items()}


def detect_format(path: Path) -> str:
    """Name of the first format that ``path`` looks like.

    Raises:
        SequenceError: nothing is there, or no format fits; the message lists what each format looks for.
    """
    if not path.exists():
        raise SequenceNotFoundError(f"{path} does not exist; expected the file or folder of a recording")
    name = next((name for name, f in FORMATS.items() if f.recognise(path)), None)
    if name is None:
        described = "; ".join(f"{n}: {f.looks_for}" for n, f in FORMATS.items())
        raise SequenceError(f"{path} is in no known format; looked for {described}")
    return name
