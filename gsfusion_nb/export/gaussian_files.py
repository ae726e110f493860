"""Reading Gaussians from any of the files in which programs exchange them; the kind is told by the first bytes."""

import math
from collections.abc import Callable
from pathlib import Path

from ..errors import SequenceError
from ..foreign import open_regular
from ..operands import FARTHEST
from ..types import GaussianParams
from .gaussian_ply import read_gaussian_ply
from .map_glb import read_map_glb
from .sog_file import read_sog
from .splat_file import read_splat
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
