"""The TSDF in a run's folder, ``tsdf.npz``: what pictures need of a map that draws its surface, and
what a camera is aligned with that is to be found in the map.

A compressed numpy archive with the observed voxels only: ``block_coords`` [B, 3] int32,
``observed`` [B, 64] (512 bits a block, the first voxel in the highest bit), and for the V observed
voxels, block by block, ``D`` [V] int16 in multiples of 1/32767, ``W`` [V] float16 and ``rgb`` [3,
V] uint8. ``voxel_size_m`` and ``truncation_m`` say how large they are. The rounding of D is 1/32767
of the truncation distance; that of a colour is half a level of 255.
"""

import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..config import TsdfConfig, to_dict
from ..errors import SequenceError
from ..files import atomic_file, check_memory, open_arrays, parsing
from ..tsdf import TsdfVolume
from ..tsdf.block_pool import VOXELS_PER_BLOCK

TSDF = "tsdf.npz"
"""The file in a run's folder."""
WHAT = "the TSDF of a run, written by write_tsdf"
D_LEVELS = 32767.0
RGB_LEVELS = 255.0
_FAST: dict[str, Any] = {"compression": zipfile.ZIP_DEFLATED, "compresslevel": 1}
"""As ``np.savez_compressed`` writes, but in a third of the time."""
_LEAST_W = 2.0**-14
_MOST_W = 65504.0
"""Half-precision weights stay positive and finite."""


def write_tsdf(path: str | Path, volume: TsdfVolume) -> None:
    """Write the observed voxels of a volume, atomically; about 4 bytes for each."""
    has_weight = volume.W > 0
    place = has_weight.view(-1).nonzero()[:, 0]
    # a block has three planes of colour
    in_planes = place + place // VOXELS_PER_BLOCK * (2 * VOXELS_PER_BLOCK)
    rgb = volume.rgb_planes.reshape(-1)
    planes = [rgb[in_planes + k * VOXELS_PER_BLOCK] for k in range(3)]
    columns = {
        "voxel_size_m": np.float64(volume.config.voxel_size_m),
        "truncation_m": np.float64(volume.config.truncation_m),
        "block_coords": volume.block_coords.cpu().numpy().astype("<i4"),
        "observed": np.packbits(has_weight.cpu().numpy(), axis=1),
        "D": _levels(volume.D.view(-1)[place], D_LEVELS)
        .to(torch.int16)
        .cpu()
        .numpy()
        .astype("<i2"),
        "W": _half(volume.W.view(-1)[place]).cpu().numpy().astype("<f2"),
        "rgb": torch.stack([_levels(plane, RGB_LEVELS).to(torch.uint8) for plane in planes])
        .cpu()
        .numpy(),
    }
    with atomic_file(path) as temporary, zipfile.ZipFile(temporary, "w", **_FAST) as archive:
        for name, values in columns.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(values), allow_pickle=False)


def read_tsdf(
    path: str | Path, config: TsdfConfig, device: torch.device | str = "cpu"
) -> TsdfVolume:
    """The volume that ``write_tsdf`` wrote; what was not observed is as in a new block.

    Args:
        path: The file.
        config: Settings of the volume; they must give the voxels the size that they have in the
            file.
        device: Device of the volume.

    Raises:
        FileNotFoundError: no such file. ValueError: another file, a damaged one, or voxels of
            another size.
    """
    path = Path(path)
    with open_arrays(path, WHAT) as archive:
        _check_arrays(path, archive)
        for name, expected_type in (
            ("voxel_size_m", config.voxel_size_m),
            ("truncation_m", config.truncation_m),
        ):
            if not math.isclose(float(archive[name]), expected_type, rel_tol=1e-9):
                raise SequenceError(
                    f"{path} has {name} {float(archive[name]):g}, but the settings of the run say "
                    f"{expected_type:g}"
                )
        coords = archive["block_coords"]
        check_memory(path, len(coords) * _READ_BYTES, WHAT)
        D, W, rgb = (archive[name] for name in ("D", "W", "rgb"))
        has_weight = torch.from_numpy(np.unpackbits(archive["observed"], axis=1).astype(bool))
    n = len(coords)
    columns: dict[str, Any] = {
        "D": torch.ones(n, VOXELS_PER_BLOCK),
        "W": torch.zeros(n, VOXELS_PER_BLOCK),
    }
    planes = torch.zeros(3, n, VOXELS_PER_BLOCK)
    volume = TsdfVolume(config, device)
    with parsing(path, WHAT):
        columns["D"][has_weight] = torch.from_numpy(D.astype(np.float32)) / D_LEVELS
        columns["W"][has_weight] = torch.from_numpy(W.astype(np.float32))
        for plane, values in zip(planes, rgb, strict=True):
            plane[has_weight] = torch.from_numpy(values.astype(np.float32)) / RGB_LEVELS
        state = columns | {
            "rgb": planes.transpose(0, 1).contiguous(),
            "block_coords": torch.from_numpy(coords),
        }
        volume.load_state_dict({"config": to_dict(config), **state})
    return volume


_ARRAYS = {
    "voxel_size_m": ("<f8", ()),
    "truncation_m": ("<f8", ()),
    "block_coords": ("<i4", ("B", 3)),
    "observed": ("u1", ("B", VOXELS_PER_BLOCK // 8)),
    "D": ("<i2", ("V",)),
    "W": ("<f2", ("V",)),
    "rgb": ("u1", (3, "V")),
}
"""Type and shape of each array: B blocks, V observed voxels."""
_BITS = np.array([number.bit_count() for number in range(256)], np.uint8)
"""Number of bits of each byte."""


def _check_arrays(path: Path, archive: Any) -> None:
    """Raise ``SequenceError`` unless the arrays are those of ``write_tsdf``, of sizes that agree,
    with its values."""
    sizes: dict[str, int] = {}
    for name, (kind, shape) in _ARRAYS.items():
        if name not in archive.files:
            raise SequenceError(f"{path} has no array {name}; expected {WHAT}")
        array = archive[name]
        fits = len(shape) == array.ndim and array.dtype == np.dtype(kind)
        expected_sizes = shape
        if fits:
            axes = zip(shape, array.shape, strict=True)
            expected_sizes = tuple(
                sizes.setdefault(n, size) if isinstance(n, str) else n for n, size in axes
            )
        if not fits or array.shape != expected_sizes:
            raise SequenceError(
                f"{path}: {name} is {list(array.shape)} of {array.dtype}, expected "
                f"{list(expected_sizes)} of {np.dtype(kind)}; expected {WHAT}"
            )
    n_observed = int(_BITS[archive["observed"]].sum(dtype=np.int64))
    if n_observed != sizes["V"]:
        raise SequenceError(
            f"{path} marks {n_observed} voxels as observed, but has the values of {sizes['V']}"
        )
    D = archive["D"]
    W = archive["W"]
    if D.size and D.min() < -D_LEVELS:
        raise SequenceError(
            f"{path}: D must be at least {-D_LEVELS:g}, got {D.min()}; expected {WHAT}"
        )
    if W.size and not (np.isfinite(W).all() and W.min() > 0):
        raise SequenceError(
            f"{path}: W must be above 0 and finite for each observed voxel; expected {WHAT}"
        )


_BLOCK_BYTES = 20 * VOXELS_PER_BLOCK
"""Of a block in memory: D, W and three colours as float32."""
_READ_BYTES = 3 * _BLOCK_BYTES
"""Of a block while it is read: unpacked, with its colours in the volume's order, and in the
volume."""


def as_stored(volume: TsdfVolume) -> TsdfVolume:
    """A copy of the volume with the values that ``read_tsdf`` will give back, bit for bit."""
    copy = volume.to(volume.device)
    unknown = copy.W <= 0
    copy.D.copy_(_levels(copy.D, D_LEVELS).div_(D_LEVELS)).masked_fill_(unknown, 1.0)
    copy.W.copy_(_half(copy.W)).masked_fill_(unknown, 0.0)
    copy.rgb_planes.copy_(_levels(copy.rgb_planes, RGB_LEVELS).div_(RGB_LEVELS))
    copy.rgb_planes.masked_fill_(unknown[:, None], 0.0)
    if copy.config.weighs_colours:
        copy.W_rgb.copy_(copy.W)  # the file has none: pictures do not need them
    return copy


def _levels(values: Tensor, levels: float) -> Tensor:
    """Values as whole numbers of levels; colours beyond 0..1 and distances beyond -1..1 do not
    occur."""
    return values.clamp(-1, 1).mul_(levels).round_()


def _half(W: Tensor) -> Tensor:
    return W.clamp(_LEAST_W, _MOST_W).half()
