"""What a file of Gaussians says about the meaning of its numbers: by its first bytes, properties
and comments."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import shown
from ..errors import ArgumentError, SequenceError
from ..files import open_regular

N_REST = 45
PLACE = ("x", "y", "z")
SCALES = tuple(f"scale_{i}" for i in range(3))
QUATERNION = tuple(f"rot_{i}" for i in range(4))
CONSTANT_COLOUR = tuple(f"f_dc_{i}" for i in range(3))
NAMES = (
    *PLACE,
    *("nx", "ny", "nz"),
    *CONSTANT_COLOUR,
    *(f"f_rest_{i}" for i in range(N_REST)),
    "opacity",
    *SCALES,
    *QUATERNION,
)
"""The 62 properties in the order of the file."""

_PACKED = {".spz": "SPZ", ".splat": "splat", ".ksplat": "ksplat", ".sog": "SOG"}
_MAGIC = {b"\x1f\x8b": ".spz", b"NGSP": ".spz", b"PK\x03\x04": ".sog"}
_CONVERTER = "npx @playcanvas/splat-transform"
_OTHER_KINDS = {
    "anchors of Scaffold-GS, of which a network makes Gaussians": re.compile(
        r"f_anchor_feat_\d+|f_offset_\d+"
    ),
    "Gaussians that move in time": re.compile(
        r"t|time|t_scale|scale_t|trbf_\w+|motion_\d+|omega_\d+|rot_r_\d+|f_t_\d+"
    ),
}
"""Kinds whose properties say that the usual ones mean something else."""
_BESIDE = re.compile(
    r"n[xyz]|red|green|blue|alpha|[rgba]|id|\w+_id|\w*(label|class|confidence|semantic|segment|object|instance|mask|state|"
    r"weight|count)\w*"
)
"""Properties that say something beside the Gaussian."""
_MODE = re.compile(r"\s*(?:SplatRenderMode:\s*(\S+)|antialiased\s+(\d+))\s*", re.IGNORECASE)
"""Comments of Brush and of Postshot."""


_MAY_CHANGE_PLACES = re.compile(
    r"(?i).*(?<![a-z])(units?|scale|offset|shift|origin|epsg|crs|(vertical|up)[\s_-]*axis|y[\s_-]*up"
    r"|z[\s_-]*up)(?![a-z]).*"
)
"""Comments that may say in which unit, axes or place the Gaussians are."""

_FEWEST_TO_JUDGE = 100
"""Gaussians whose numbers may be told from logarithms and logits."""


def refuse_packed(path: Path, what: str) -> None:
    """Raise ``SequenceError`` for Gaussians that are packed otherwise than as PLY; names what makes
    a PLY of them."""
    with open_regular(path, what) as file:
        head = file.read(4)
    suffix = next(
        (suffix for magic, suffix in _MAGIC.items() if head.startswith(magic)),
        path.suffix.lower(),
    )
    if suffix in _PACKED and not head.startswith(b"ply"):
        raise SequenceError(
            f"{path} is a {_PACKED[suffix]} file; expected {what}, as this makes one: {_CONVERTER} "
            f"{path.name} {path.stem}.ply"
        )


def needed_columns(path: Path, ply: Any, what: str) -> list[str]:
    """Names of the properties that make the Gaussians, with that of a smoothing filter where there
    is one.

    Raises:
        ValueError: one is missing, or the file holds another kind of Gaussians, which the message
            names.
    """
    present = _properties(ply)
    if "chunk" in ply and any(name.startswith("packed_") for name in present):
        raise SequenceError(
            f"{path} is a compressed PLY; expected {what} as trained, as this makes one: "
            f"{_CONVERTER} {path.name} plain.ply"
        )
    for kind, pattern in _OTHER_KINDS.items():
        matches = [name for name in present if pattern.fullmatch(name)]
        if matches:
            raise SequenceError(
                f"{path} holds {kind} (property {matches[0]}); expected Gaussians that stand for "
                "themselves"
            )
    n_rest = sum(name.startswith("f_rest_") for name in present)
    rest = [f"f_rest_{i}" for i in range(n_rest)]
    columns = [*PLACE, *CONSTANT_COLOUR, *rest, "opacity", *SCALES, *QUATERNION]
    lacking = [name for name in columns if name not in present]
    if lacking == ["scale_2"]:
        raise SequenceError(
            f"{path} holds flat Gaussians of 2D Gaussian Splatting (2DGS), which have no scale_2 "
            "and are drawn by other equations; expected Gaussians with three scales"
        )
    if lacking:
        raise ArgumentError(f"{path} has no properties {', '.join(lacking)}; expected {what}")
    if n_rest not in (0, 9, 24, N_REST):
        raise ArgumentError(
            f"{path} must have 0, 9, 24 or 45 f_rest properties (degree 0 to 3), got {n_rest}"
        )
    filters = filter_column(present)
    return [*columns, filters] if filters else columns


def filter_column(names: list[str]) -> str:
    """The property that holds the 3D smoothing filter of Mip-Splatting, or empty."""
    return next((name for name in names if name.lower() == "filter_3d"), "")


def notes_on_meaning(ply: Any) -> list[str]:
    """Sentences on what the file says of its Gaussians beside the usual properties."""
    notes = []
    present = _properties(ply)
    filters = filter_column(present)
    if filters:
        notes.append(
            f"{filters} was applied: the Gaussians are as wide as their trainer smooths them"
        )
    modes = [match for comment in ply.comments if (match := _MODE.fullmatch(comment))]
    mode = (modes[-1][1] or ("mip" if int(modes[-1][2]) else "default")) if modes else "default"
    if mode.lower() != "default":
        notes.append(
            f"it was trained for the render mode {mode[:40]}, which this package does not have: "
            "Gaussians smaller than a pixel are drawn stronger than they should be"
        )
    notes += [
        f"its comment {shown(comment)} is not used: places are read as metres as they stand"
        for comment in ply.comments
        if _MAY_CHANGE_PLACES.fullmatch(comment)
    ][:3]
    notes += _doubts(ply)
    unknown = [
        name
        for name in present
        if name not in (*NAMES, filters) and not _BESIDE.fullmatch(name.lower())
    ]
    if unknown:
        notes.append(f"the properties {', '.join(unknown[:8])} are not known and not used")
    return notes


def _doubts(ply: Any) -> list[str]:
    """Sentences on numbers that are not as those that trainers write."""
    rows: Any = ply["vertex"].data if "vertex" in ply else ()
    if len(rows) < _FEWEST_TO_JUDGE:
        return []
    doubts = []
    scales = np.stack([rows[name] for name in SCALES])
    if bool(((scales > 0) & (scales < 1)).all()):
        doubts.append(
            "its scales are all between 0 and 1, as lengths are, but are read as their logarithms, "
            "as trainers write them: each Gaussian becomes larger than 1 m"
        )
    opacity = rows["opacity"]
    if bool(((opacity >= 0) & (opacity <= 1)).all()):
        doubts.append(
            "its opacities are all between 0 and 1, as opacities are, but are read as their "
            "logits, as trainers write them: none becomes smaller than 0.5"
        )
    return doubts


def _properties(ply: Any) -> list[str]:
    return list(ply["vertex"].data.dtype.names or ()) if "vertex" in ply else []
