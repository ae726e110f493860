"""The PLY file of 3D Gaussian splatting, which public viewers can open (layout of Kerbl et al. 2023's released code).

Binary little endian, 62 float32 properties, 248 bytes per Gaussian, before activation:
``x y z nx ny nz f_dc_0..2 f_rest_0..44 opacity scale_0..2 rot_0..3``. Normals are 0; ``f_rest`` holds 15 coefficients
of red, then 15 of green, then 15 of blue; opacity is a logit, scales are logarithms, the quaternion is wxyz.
"""

import math
from pathlib import Path

import numpy as np
import torch

from ..files import atomic_file
from ..foreign import parsing
from ..geometry.spherical_harmonics import rgb_to_sh_dc
from ..types import GaussianParams
from .compressed_ply import decompressed, is_compressed
from .ply_header import check_ply_header, check_ply_rows

_REST = 45
_RGB = ("red", "green", "blue")
_DISC_LOG_M = math.log(1e-6)
NAMES = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(_REST)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)
"""The 62 properties in the order of the file."""


def write_gaussian_ply(path: str | Path, params: GaussianParams) -> None:
    """Write a Gaussian map in the standard layout, atomically.

    Colours of a lower SH degree are padded with zero coefficients to degree 3, which looks the same and can be opened
    by every viewer.

    Raises:
        ValueError: The SH degree is above 3.
    """
    from plyfile import PlyData, PlyElement

    n, coefficients = params.sh.shape[:2]
    if coefficients not in (1, 4, 9, 16):
        raise ValueError(f"sh must have 1, 4, 9 or 16 coefficients (degree 0 to 3), got {coefficients}")
    sh = params.sh.detach()
    rest = sh.new_zeros(n, 3, 15)
    rest[:, :, : coefficients - 1] = sh[:, 1:].transpose(1, 2)  # by channel, then coefficient
    columns = [
        params.xyz_W,
        torch.zeros_like(params.xyz_W),
        sh[:, 0],
        rest.reshape(n, _REST),
        params.opacity_logit[:, None],
        params.log_scale,
        params.quat,
    ]
    table = torch.cat([c.detach().to("cpu", torch.float32) for c in columns], dim=1).contiguous().numpy()
    rows = table.astype("<f4", copy=False).view([(name, "<f4") for name in NAMES]).reshape(n)
    with atomic_file(path, size_bytes=table.nbytes) as temporary:
        PlyData([PlyElement.describe(rows, "vertex")], text=False, byte_order="<").write(str(temporary))


def read_gaussian_ply(path: str | Path) -> GaussianParams:
    """Read a Gaussian map written by this or another program; 0, 9, 24 or 45 ``f_rest`` properties give degree 0 to 3.

    The order of the properties, their types and the byte order do not matter; what is not needed is skipped. A file of
    2D Gaussian splatting has no ``scale_2``: its discs get a thickness of a micrometre. Colours given as ``red green
    blue`` 0..255 instead of ``f_dc`` are accepted, and so are compressed PLY files (``compressed_ply``).

    Raises:
        FileNotFoundError: The file does not exist. ValueError: The file is not a PLY file of Gaussians, is truncated,
            or contains NaN; the message names the missing part or the first such row.
    """
    path, what = Path(path), "a PLY file of Gaussians"
    check_ply_header(path, what)
    with parsing(path, what):
        ply = _read(path)
    if "vertex" not in ply:
        raise ValueError(f"{path} has no element 'vertex'; expected a PLY file of Gaussians")
    if is_compressed(ply):
        with parsing(path, what):
            return decompressed(path, ply)
    data = ply["vertex"].data
    present = set(data.dtype.names or ())
    n_rest = sum(name.startswith("f_rest_") for name in present)
    rest_names = tuple(f"f_rest_{i}" for i in range(n_rest))
    has_rgb = not present.intersection(NAMES[6:9]) and present.issuperset(_RGB)
    colour_names = _RGB if has_rgb else NAMES[6:9]
    flat = "scale_2" not in present
    shape_names = [n for n in NAMES[-8:] if not (flat and n == "scale_2" and "scale_1" in present)]
    lacking = [n for n in (*NAMES[:3], *colour_names, *rest_names, *shape_names) if n not in present]
    if lacking:
        raise ValueError(f"{path} has no properties {', '.join(lacking)}; expected a PLY file of Gaussians")
    if n_rest not in (0, 9, 24, 45):
        raise ValueError(f"{path} must have 0, 9, 24 or 45 f_rest properties (degree 0 to 3), got {n_rest}")

    def columns(*names: str) -> torch.Tensor:
        out = np.empty((len(data), len(names)), dtype=np.float32)
        with parsing(path, what), np.errstate(over="ignore"):
            for i, name in enumerate(names):
                out[:, i] = data[name]
        check_ply_rows(path, "vertex", out, names)
        return torch.from_numpy(out)

    rest = columns(*rest_names).reshape(len(data), 3, n_rest // 3).transpose(1, 2)
    scale = columns("scale_0", "scale_1") if flat else columns("scale_0", "scale_1", "scale_2")
    scale = torch.cat([scale, torch.full_like(scale[:, :1], _DISC_LOG_M)], dim=1) if flat else scale
    dc = columns(*colour_names)
    dc = rgb_to_sh_dc(dc / 255) if has_rgb else dc
    return GaussianParams(
        xyz_W=columns("x", "y", "z"),
        log_scale=scale,
        quat=columns("rot_0", "rot_1", "rot_2", "rot_3"),
        opacity_logit=columns("opacity")[:, 0],
        sh=torch.cat([dc[:, None], rest], dim=1),
    )


def _read(path: Path):
    """The parsed file. It is memory-mapped, which is faster; a file without rows cannot be, and is read normally."""
    from plyfile import PlyData

    try:
        return PlyData.read(str(path))
    except ValueError:
        return PlyData.read(str(path), mmap=False)  # pyright: ignore[reportArgumentType]
