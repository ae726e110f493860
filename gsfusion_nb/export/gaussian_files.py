"""Reading Gaussians from any of the files in which programs exchange them; the kind is told by the first bytes.

A ``.splat`` file (of the web viewer antimatter15/splat) has none of its own: 32 bytes per Gaussian, three float32 for
the centre, three for the standard deviations in units of the world, four bytes red, green, blue and opacity, four bytes
for the rotation wxyz. Colours do not depend on the direction. The frame is that of the PLY file it was made from.
"""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..files import SequenceError, open_regular, read_bytes
from ..geometry.operands import FARTHEST
from ..types import GaussianParams
from .map_glb import read_map_glb
from .packed_values import MAX_BYTES, params_of, sh_of_rgb
from .ply import check_ply_rows, read_gaussian_ply
from .sog_file import read_sog
from .spz_file import read_spz

WHAT = "a file of Gaussians (.ply, .glb, .splat, .spz or .sog)"
_BEGINNINGS: dict[bytes, Callable[[Path], GaussianParams]] = {
    b"ply": read_gaussian_ply,
    b"glTF": lambda path: read_map_glb(path)[0],
    b"\x1f\x8b": read_spz,
    b"NGSP": read_spz,
    b"PK\x03\x04": read_sog,
}


def read_gaussians(path: str | Path) -> GaussianParams:
    """Read a map of Gaussians that this or another program wrote, in the frame of the file.

    ``.ply`` (3D Gaussian splatting of any degree, 2D Gaussian splatting, compressed PLY of SuperSplat), ``.glb``
    (``KHR_gaussian_splatting``), ``.splat``, ``.spz`` (versions 2 to 4), ``.sog`` (version 2).

    Raises:
        FileNotFoundError: no such file. ValueError: another kind of file, or a damaged one; the message says what.
    """
    path = Path(path)
    with open_regular(path, WHAT) as file:
        head = file.read(4)
    read = next((read for beginning, read in _BEGINNINGS.items() if head.startswith(beginning)), None)
    if read is None and path.suffix.lower() == ".splat":  # has no mark of its own
        read = read_splat
    if read is None:
        raise SequenceError(f"{path} begins with {head!r}; expected {WHAT}")
    return _plausible(path, read(path))


def _plausible(path: Path, gaussians: GaussianParams) -> GaussianParams:
    """Raise ``SequenceError`` for Gaussians that no map has: too far away, too large, or without a rotation."""
    for what, bad in (
        (f"a place beyond {FARTHEST:g}", (gaussians.xyz_W.abs() > FARTHEST).any(dim=1)),
        (f"a size above {FARTHEST:g}", (gaussians.log_scale > math.log(FARTHEST)).any(dim=1)),
        ("a rotation whose quaternion is zero", (gaussians.quat == 0).all(dim=1)),
    ):
        if bad.any():
            raise SequenceError(
                f"{path} has {what} in {int(bad.sum())} rows of Gaussians, the first is row {int(bad.int().argmax())}; "
                f"it is damaged, or another kind; expected {WHAT}"
            )
    return gaussians


_ROW = np.dtype([("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
_LEAST_M = 1e-9


def read_splat(path: str | Path) -> GaussianParams:
    """Read a ``.splat`` file.

    Raises:
        FileNotFoundError: no such file. ValueError: its length is not a multiple of 32 bytes, or a number is NaN.
    """
    path = Path(path)
    data = read_bytes(path, "a .splat file of Gaussians", at_most=MAX_BYTES)
    if len(data) % _ROW.itemsize:
        raise SequenceError(
            f"{path} has {len(data)} bytes; a .splat file has a multiple of 32; truncated or another kind"
        )
    rows = np.frombuffer(data, _ROW)
    check_ply_rows(path, "Gaussians", np.concatenate([rows["xyz"], rows["scale"]], axis=1), _NAMES)
    if len(rows) and not bool((rows["scale"] >= 0).all()):
        raise SequenceError(f"{path} has negative sizes; expected a .splat file of Gaussians")
    rgba = rows["rgba"] / 255.0
    quat = (rows["quat"].astype(np.float64) - 128.0) / 128.0
    return params_of(
        rows["xyz"].copy(), np.log(np.maximum(rows["scale"].astype(np.float64), _LEAST_M)), quat, rgba[:, 3],
        sh_of_rgb(rgba[:, :3])[:, None],
    )  # fmt: skip


_NAMES = ("x", "y", "z", "scale x", "scale y", "scale z")
