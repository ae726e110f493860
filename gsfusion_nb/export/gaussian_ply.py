"""PLY files of 3D Gaussian splatting, which public viewers can open (layout of Kerbl et al. 2023's
released code).

Gaussians are binary little endian, 62 float32 properties, 248 bytes each, before activation:
``x y z nx ny nz f_dc_0..2 f_rest_0..44 opacity scale_0..2 rot_0..3``. Normals are 0; ``f_rest``
holds 15 coefficients of red, then 15 of green, then 15 of blue; opacity is a logit, scales are
logarithms, the quaternion is wxyz.

Files of other trainers may say more: a smoothing filter of each Gaussian, a mode of rendering,
float64 places.
"""

import logging
import math
from pathlib import Path

import numpy as np
import torch

from ..errors import ArgumentError, SequenceError
from ..files import atomic_file, parsing
from ..types import GaussianParams
from .gaussian_kinds import (
    CONSTANT_COLOUR,
    N_REST,
    NAMES,
    PLACE,
    QUATERNION,
    SCALES,
    filter_column,
    needed_columns,
    notes_on_meaning,
    refuse_packed,
)
from .ply import read_ply

log = logging.getLogger(__name__)

FARTHEST = 1e7
"""No coordinate and no size of a Gaussian is larger in a map, in any unit."""
OPAQUE_LOGIT = 20.0
"""In place of an infinite logit: float32 rounds its opacity to 1."""
FLAT_LOG_SCALE = -20.0
"""In place of the logarithm of a size of 0."""
COARSE_M = 1e-4
"""Places that float32 would round by more are moved to the origin."""
COARSE_FILE_M = 1e-3
"""Larger steps of the places in a file are said."""

_WHAT = "a PLY file of Gaussians"
"""What is expected, in messages."""


def write_gaussian_ply(path: str | Path, params: GaussianParams) -> None:
    """Write a Gaussian map in the standard layout, atomically.

    Colours of a lower SH degree are padded with zero coefficients to degree 3, which looks the same
    and can be opened by every viewer.

    Raises:
        ValueError: The SH degree is above 3.
    """
    from plyfile import PlyData, PlyElement

    n, coefficients = params.sh.shape[:2]
    if coefficients not in (1, 4, 9, 16):
        raise ArgumentError(
            f"sh must have 1, 4, 9 or 16 coefficients (degree 0 to 3), got {coefficients}"
        )
    sh = params.sh.detach()
    rest = sh.new_zeros(n, 3, 15)
    rest[:, :, : coefficients - 1] = sh[:, 1:].transpose(1, 2)  # by channel, then coefficient
    columns = [
        params.xyz_W,
        torch.zeros_like(params.xyz_W),
        sh[:, 0],
        rest.reshape(n, N_REST),
        params.opacity_logit[:, None],
        params.log_scale,
        params.quat,
    ]
    table = (
        torch.cat(
            [c.detach().to("cpu", torch.float32) for c in columns],
            dim=1,
        )
        .contiguous()
        .numpy()
    )
    rows = table.astype("<f4", copy=False).view([(name, "<f4") for name in NAMES]).reshape(n)
    with atomic_file(path) as temporary:
        PlyData([PlyElement.describe(rows, "vertex")], text=False, byte_order="<").write(
            str(temporary)
        )


def read_gaussian_ply(
    path: str | Path, *, strict: bool = False, keep_place: bool = False
) -> GaussianParams:
    """Read a Gaussian map written by this or another program; 0, 9, 24 or 45 ``f_rest`` properties
    give degree 0 to 3.

    The order of the properties, their types and the byte order do not matter. What changes the
    meaning of others is applied or refused by name, and a warning of the log says what was done:

    - ``filter_3D`` (Mip-Splatting, Gaussian Opacity Fields) widens each Gaussian and lowers its
      opacity (Yu et al. 2024, Eq. 9).
    - float64 places that float32 would round, as of a survey, are moved by whole metres.
    - Rows that are no Gaussians (NaN, a quaternion of 0, beyond ``FARTHEST``) are left out and
      counted. An infinite logit of opacity is an opaque Gaussian.
    - A mode of rendering that the file names (``SplatRenderMode: mip``) is named, because this
      package has only one.

    Args:
        path: The file.
        strict: Refuse the file for one such row, as for the file of an own run.
        keep_place: Refuse the file where places would have to be moved.

    Raises:
        FileNotFoundError: The file does not exist. ValueError: The file is not a PLY file of
            Gaussians, is truncated, or holds Gaussians of another kind or none at all; the message
            names the missing part, the kind, or the first bad row. Of packed formats it names a
            converter.
    """
    path = Path(path)
    refuse_packed(path, _WHAT)
    ply = read_ply(path, _WHAT)
    data = ply["vertex"].data if "vertex" in ply else np.zeros(0, [])
    names = needed_columns(path, ply, _WHAT)
    notes = notes_on_meaning(ply)
    with parsing(path, _WHAT), np.errstate(over="ignore"):
        place, moved_m = _places(data)
        table = {name: data[name].astype(np.float32) for name in names}
        table |= dict(zip(PLACE, place.astype(np.float32).T, strict=True))
    if moved_m.any() and keep_place:
        raise SequenceError(
            f"{path} has places near ({', '.join(f'{v:.0f}' for v in moved_m)}), which float32 "
            "would round; expected places not far from 0, in the frame of the poses"
        )
    notes += _notes_on_places(data, moved_m)
    _make_finite(table)
    bad = _bad_rows(table)
    is_good = np.ones(len(data), dtype=bool)
    for rows, _ in bad.values():
        is_good &= ~rows
    if bad and (strict or not is_good.any()):
        _, first_clause = next(iter(bad.values()))
        raise SequenceError(f"{path} {first_clause}; expected {_WHAT}")
    if bad:
        notes.append(_note_on_bad_rows(bad, is_good))
    for note in notes:
        log.warning("%s: %s", path, note)
    return _filtered(
        {name: column[is_good] for name, column in table.items()},
        filter_column(names),
    )


def _places(data: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places, float64, and the whole metres that were subtracted, so that float32 holds them. [N,
    3], [3]"""
    place = np.stack([data[axis].astype(np.float64) for axis in PLACE], axis=1)
    finite_place = place[(np.abs(place) <= FARTHEST).all(axis=1)]
    rounding_m = np.abs(finite_place - finite_place.astype(np.float32)).max(initial=0.0, axis=0)
    middle = np.round(np.median(finite_place, axis=0)) if len(finite_place) else np.zeros(3)
    moved_m = np.where(rounding_m > COARSE_M, middle, 0.0)
    return place - moved_m, moved_m


def _notes_on_places(data: np.ndarray, moved_m: np.ndarray) -> list[str]:
    """Sentences on places that float32 does not hold exactly enough."""
    if moved_m.any():
        by = ", ".join(f"{v:.0f}" for v in np.negative(moved_m) + 0.0)
        return [f"places were moved by ({by}), because float32 would round them"]
    farthest = max(
        (float(np.abs(data[axis][np.isfinite(data[axis])]).max(initial=0.0)) for axis in PLACE),
        default=0.0,
    )
    step = float(np.spacing(np.float32(min(farthest, FARTHEST))))
    if step < COARSE_FILE_M:
        return []
    return [f"places of up to {farthest:.0f} have steps of {step:g} as the file stores them"]


def _make_finite(table: dict[str, np.ndarray]) -> None:
    """Replace the infinities that mean something: an opaque Gaussian, and one without thickness."""
    opacity = table["opacity"]
    opacity[opacity == np.inf] = OPAQUE_LOGIT
    for name in SCALES:
        table[name][table[name] == -np.inf] = FLAT_LOG_SCALE


def _bad_rows(table: dict[str, np.ndarray]) -> dict[str, tuple[np.ndarray, str]]:
    """Rows that are no Gaussians: why, which they are, and a clause on the first; only reasons that
    occur."""
    counts = {}
    is_bad = np.zeros(len(table["opacity"]), dtype=bool)
    unknown = is_bad.copy()
    first = ""
    for name, column in table.items():
        wrong = ~np.isfinite(column)
        if wrong.any() and not first:
            first = f"contains NaN or infinities, the first is {name} of row {wrong.argmax()}"
        unknown |= wrong
    reasons = {
        "NaN or infinities": unknown,
        f"a place beyond {FARTHEST:g}": (np.abs(_stacked(table, PLACE)) > FARTHEST).any(axis=1),
        f"a size above {FARTHEST:g}": (_stacked(table, SCALES) > math.log(FARTHEST)).any(axis=1),
        "a rotation whose quaternion is zero": (_stacked(table, QUATERNION) == 0).all(axis=1),
    }
    for reason, wrong in reasons.items():
        rows = wrong & ~is_bad
        is_bad |= rows
        if rows.any():
            clause = (
                first if wrong is unknown else f"has {reason} in row {rows.argmax()} of Gaussians"
            )
            counts[f"with {reason}"] = (rows, clause)
    return counts


def _note_on_bad_rows(bad: dict[str, tuple[np.ndarray, str]], is_good: np.ndarray) -> str:
    """How many rows were left out, and why."""
    reasons = [
        f"{int(rows.sum())} {why}, the first in row {rows.argmax()}"
        for why, (rows, _) in bad.items()
    ]
    n_bad = int((~is_good).sum())
    return f"{n_bad:,} of {len(is_good):,} Gaussians were left out: {'; '.join(reasons)}"


def _stacked(
    table: dict[str, np.ndarray],
    names: tuple[str, ...],
) -> np.ndarray:
    columns = np.empty((len(table["opacity"]), len(names)), dtype=np.float32)
    for i, name in enumerate(names):
        columns[:, i] = table[name]
    return columns


def _filtered(table: dict[str, np.ndarray], filter_name: str) -> GaussianParams:
    """The Gaussians of the columns; with the 3D smoothing filter of Mip-Splatting (Yu et al. 2024,
    Eq. 9) if there is one, whose column holds its standard deviation f: Sigma' = Sigma + f^2 I, o'
    = o sqrt(|Sigma| / |Sigma'|)."""
    log_scale = torch.from_numpy(_stacked(table, SCALES))
    opacity_logit = torch.from_numpy(table["opacity"].copy())
    if filter_name:
        variance = (2 * log_scale.double()).exp()
        smooth_variance = variance + torch.from_numpy(table[filter_name]).double().square()[:, None]
        share = (0.5 * (variance.log() - smooth_variance.log())).sum(dim=1).exp()
        peak = share * opacity_logit.double().sigmoid()
        opacity_logit = torch.logit(peak, eps=1e-12).clamp(max=OPAQUE_LOGIT).float()
        log_scale = (0.5 * smooth_variance.log()).float()
    n_rest = sum(name.startswith("f_rest_") for name in table)
    rest = torch.from_numpy(_stacked(table, tuple(f"f_rest_{i}" for i in range(n_rest))))
    constant = torch.from_numpy(_stacked(table, CONSTANT_COLOUR))
    return GaussianParams(
        xyz_W=torch.from_numpy(_stacked(table, PLACE)),
        log_scale=log_scale,
        quat=torch.from_numpy(_stacked(table, QUATERNION)),
        opacity_logit=opacity_logit,
        sh=torch.cat(
            [constant[:, None], rest.reshape(len(rest), 3, n_rest // 3).transpose(1, 2)], dim=1
        ),
    )
