"""Reading ``.splat`` files (the format of the web viewer antimatter15/splat): 32 bytes per Gaussian.

Three float32 for the centre, three for the standard deviations in units of the world, four bytes red, green, blue and
opacity, four bytes for the rotation wxyz. Colours do not depend on the direction. The frame is that of the PLY file it
was made from.
"""

from pathlib import Path

import numpy as np

from ..errors import SequenceError
from ..foreign import read_bytes
from ..types import GaussianParams
from .packed_values import params_of, sh_of_rgb
from .ply_header import check_ply_rows

_ROW = np.dtype([("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
MAX_BYTES = 2_000_000_000
"""Of a file that is read at once: 60 million Gaussians."""
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
