"""Checkpoints, TSDFs, and what another recording goes on with, with one wrong thing in them and
right checksums: what a program with an error would write.

A file that was damaged by a disk is found by its checksum. Here somebody made the file: values that
are not finite, rows too few or too many, another type, another kind, another count, a tensor whose
stride is 0.
"""

import copy
import hashlib
import io
import json
import random
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsfusion_nb.export import CheckpointStore
from gsfusion_nb.runs.map_state import STATE
from gsfusion_nb.runs.run_folder import CHECKPOINTS, packed, unpacked
from gsfusion_nb.tracking import PLACES

Way = tuple[str | int, ...]
"""Keys and places from the root of a state to a part of it."""


@dataclass(frozen=True)
class Alteration:
    """What was altered, and whether it has to be refused."""

    where: str
    what: str
    wrong: bool
    """False: it may be a state that another run can have come to, so it may be taken."""

    def write(self, path: Path) -> None:
        """Write it beside the altered files."""
        path.write_text(json.dumps(vars(self)))

    @staticmethod
    def read(path: Path) -> "Alteration":
        """What ``write`` wrote."""
        return Alteration(**json.loads(path.read_text()))


UNALTERED = Alteration("", "unaltered", wrong=False)
"""What has to be taken: whoever refuses everything would find no fault otherwise."""


def alter_checkpoint(folder: Path, rng: random.Random) -> Alteration:
    """Alter the checkpoint of a run's folder; its checksums are right."""
    if rng.randrange(20) == 0:
        return UNALTERED
    store = CheckpointStore(folder / CHECKPOINTS)
    state = copy.deepcopy(_loose(store.load().state))
    made = None
    while made is None:
        way = rng.choice(_ways(state, rng))
        made = _altered(state, way, rng)
    store.remove()
    CheckpointStore(folder / CHECKPOINTS).save(state)
    if rng.randrange(12) == 0:
        made = _stride(folder / CHECKPOINTS, rng) or made
    return made


def alter_onto(folder: Path, rng: random.Random) -> Alteration:
    """Alter what another recording goes on with in the map of a run: ``places.npz`` or
    ``state.zip``."""
    if rng.randrange(20) == 0:
        return UNALTERED
    if rng.randrange(3) == 0:
        return alter_arrays(folder / PLACES, rng)
    with zipfile.ZipFile(folder / STATE) as archive:
        (member,) = archive.namelist()
        document = torch.load(io.BytesIO(archive.read(member)), weights_only=True)
    state = document["state"]
    made = None
    while made is None:
        made = _altered(state, rng.choice(_ways(state, rng)), rng)
    with (
        zipfile.ZipFile(folder / STATE, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open(member, "w") as file,
    ):
        torch.save(document, file)
    is_fewer = made.where == "keyframes" and made.what in ("shorter", "empty")  # as other runs have
    return Alteration(f"{STATE}/{made.where}", made.what, made.wrong and not is_fewer)


def alter_tsdf(folder: Path, rng: random.Random) -> Alteration:
    """Alter one array of the ``tsdf.npz`` of a run's folder."""
    return UNALTERED if rng.randrange(20) == 0 else alter_arrays(folder / "tsdf.npz", rng)


ALTERERS = {
    "altered": alter_checkpoint,
    "altered_tsdf": alter_tsdf,
    "altered_onto": alter_onto,
}
"""Name of a target -> what alters the folder of a run for it."""


def alter_arrays(path: Path, rng: random.Random) -> Alteration:
    """Alter one array of an archive of NumPy's."""
    with np.load(path, allow_pickle=False) as archive:
        arrays = dict(archive.items())
    name = rng.choice(sorted(arrays))
    array = arrays[name]
    change, what, wrong = rng.choice(list(_array_changes(array, name)))
    arrays[name] = change()
    if arrays[name] is None:
        del arrays[name]
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)
    return Alteration(f"{path.name}/{name}", what, wrong)


def _loose(value: Any) -> Any:
    """A state whose packed texts are plain values again, so that these are altered, too."""
    if isinstance(value, dict):
        return {key: _loose(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_loose(part) for part in value)
    return value.clone() if isinstance(value, Tensor) else value


_NOT_ALTERED = (
    "source",
    "rule_from_file",
    "fingerprint",
    "parts",
    "training",
    "random",
    "own_settings",
)
"""Settings and codes whose other values are other runs, not wrong ones."""
_FREE_LENGTH = (
    "warnings",
    "global_losses",
    "pass_losses",
    "usual_fit",
    "losses",
    "data_files",
    "thumbnails",
    "window",
)
"""Lists of which no other part of a state says how long they are."""
_MAY_BE_NAN = (
    "pass_losses",
    "global_losses",
    "online_scores",
    "psnr_before_db",
    "psnr_after_db",
    "losses",
    "seconds",
    "timestamps_s",
    "timestamp_s",
    "tracking",
)


def _ways(state: Any, rng: random.Random) -> list[Way]:
    """Parts of a state, each branch as likely as the others."""
    found = []
    for _ in range(8):
        way = []
        value = state
        while isinstance(value, dict | list | tuple) and value and (not way or rng.randrange(6)):
            key = rng.choice(sorted(value) if isinstance(value, dict) else range(len(value)))
            way.append(key)
            value = value[key]
        if not any(name in _NOT_ALTERED for name in way):
            found.append(tuple(way))
    return found or [("run",)]


def _altered(state: Any, way: Way, rng: random.Random) -> Alteration | None:
    """Alter the part at ``way``; None if nothing can be altered there."""
    holder = state
    for key in way[:-1]:
        holder = holder[key]
    if isinstance(holder, tuple):
        return None
    value = holder[way[-1]]
    where = "/".join(map(str, way))
    if isinstance(value, Tensor) and value.dtype == torch.uint8 and _is_text(value):
        plain = unpacked(value)
        below = _ways(plain, rng)[0] if isinstance(plain, dict | list) and plain else ()
        made = _altered(plain, below, rng) if below and below[0] != "run" else None
        if made is None:
            return None
        holder[way[-1]] = packed(plain)
        return Alteration(f"{where} (packed) {made.where}", made.what, made.wrong)
    change, what, wrong = rng.choice(list(_changes(value, way)))
    new = change()
    if new is _GONE:
        del holder[way[-1]]
    else:
        holder[way[-1]] = new
    if way[0] == "ran_on" and what in ("an unknown key", "nothing") and len(way) == 1:
        wrong = False  # another program, which a run says
    return Alteration(where, what, wrong and not (_is_settings(way) and what in _OTHER_SETTINGS))


def _is_text(value: Tensor) -> bool:
    try:
        unpacked(value)
    except ValueError:
        return False
    return value.ndim == 1 and len(value) > 1


def _is_settings(way: Way) -> bool:
    return "config" in way


_GONE = object()
_OTHER_SETTINGS = ("negative", "another number", "very large", "gone", "longer", "shorter", "empty")
Change = tuple[Callable[[], Any], str, bool]


def _changes(value: Any, way: Way) -> Iterator[Change]:
    """What can be made of a value; whether it is wrong."""
    name = (
        str(way[-1])
        if isinstance(way[-1], str)
        else next(
            (str(k) for k in reversed(way) if isinstance(k, str)),
            "",
        )
    )
    free = any(part in _FREE_LENGTH for part in way)
    if isinstance(value, Tensor):
        yield from _tensor_changes(value, name, free)
    elif isinstance(value, bool):
        yield lambda: "yes", "text", True
        yield lambda: 7, "a number", True
    elif isinstance(value, int | float):
        yield lambda: "many", "text", True
        yield lambda: [value], "a list", True
        yield dict, "a dictionary", True
        yield lambda: float("nan"), "not finite", not any(part in _MAY_BE_NAN for part in way)
        yield lambda: float("inf"), "not finite", not any(part in _MAY_BE_NAN for part in way)
        if isinstance(value, int):
            yield lambda: -3, "negative", False
            yield lambda: value + 0.5, "a fraction", True
            yield lambda: 1 << 70, "very large", True
            yield lambda: value + 1, "another number", False
    elif isinstance(value, str):
        yield lambda: 7, "a number", True
        yield lambda: None, "nothing", True
        yield lambda: "\x1b[2Jnobody", "another text", False
    elif isinstance(value, dict):
        yield lambda: None, "nothing", bool(value)
        yield lambda: "text", "text", True
        yield lambda: list(value), "a list", True
        for key in value:
            yield (
                lambda key=key: {k: v for k, v in value.items() if k != key},
                f"without {key}",
                False,
            )
        yield (
            lambda: {**value, "more": 1},
            "an unknown key",
            not (
                {"tracking", "counts", "seconds"} & set(way) or name in ("online_scores", "memory")
            ),
        )
    elif isinstance(value, list | tuple):
        yield lambda: 7, "a number", True
        yield lambda: "text", "text", True
        if value:
            yield lambda: type(value)(value[:-1]), "shorter", not free
            yield lambda: type(value)([*value, value[-1]]), "longer", not free
            yield lambda: type(value)(), "empty", not free
    elif value is None:
        yield lambda: "text", "text", True
        yield lambda: torch.zeros(2, 7), "a tensor", True


def _tensor_changes(value: Tensor, name: str, free: bool) -> Iterator[Change]:
    yield lambda: None, "nothing", name != "farthest_m"  # of a view whose depth was not looked at
    yield lambda: "text", "text", True
    yield lambda: 3.0, "a number", True
    yield lambda: value[None], "a dimension more", True
    yield (
        lambda: value.to(torch.float64 if value.dtype != torch.float64 else torch.float32),
        "another type",
        True,
    )
    yield lambda: value.to(torch.complex64), "another type", True
    if value.numel() and value.is_floating_point():
        for number in (float("nan"), float("inf"), -float("inf")):
            is_hole = name == "farthest_m" and number > 0  # a part of the picture without depth
            bad = name not in _MAY_BE_NAN and not is_hole
            yield lambda number=number: _filled(value, number), "not finite", bad
        yield lambda: _filled(value, 3e38), "very large", False
        yield lambda: value.half(), "another type", True
    if value.numel() and value.dtype in (torch.int32, torch.int64):
        yield lambda: _filled(value, -7), "negative", False
        yield lambda: _filled(value, 1 << 30), "very large", False
    if value.ndim and len(value):
        yield lambda: value[:-1].clone(), "a row less", not free
        yield lambda: torch.cat([value, value[-1:]]), "a row more", not free
        yield lambda: value[:0].clone(), "empty", not free
    if value.ndim > 1 and value.shape[0] != value.shape[-1]:
        yield lambda: value.transpose(0, -1).contiguous(), "axes exchanged", True


def _filled(value: Tensor, number: float) -> Tensor:
    new = value.clone()
    new.view(-1)[new.numel() // 2] = number
    return new


def _array_changes(array: np.ndarray, name: str) -> Iterator[Change]:
    yield lambda: None, "missing", True
    yield lambda: array[None], "a dimension more", True
    yield lambda: array.astype(np.complex64), "another type", True
    yield lambda: array.astype("U"), "text", True
    if array.ndim and len(array):
        yield lambda: array[:-1], "a row less", True
        yield lambda: np.concatenate([array, array[-1:]]), "a row more", True
        yield lambda: array[:0], "empty", True
        other = np.float64 if array.dtype != np.float64 else np.float32
        yield lambda: array.astype(other), "another type", True
    elif not array.ndim:
        for number in (np.nan, np.inf, -0.1, 0.0):
            yield lambda number=number: np.float64(number), "not finite or not positive", True
    if name in ("W", "D"):
        bad = {"W": (np.nan, np.inf, -1.0), "D": (-32768,)}[name]
        for number in bad:
            yield lambda number=number: _filled_array(array, number), "no value of a voxel", True
    if name in ("camera", "T_WC", "uv", "xyz_C", "sigma_px") and array.size:
        for number in (np.nan, np.inf, -np.inf):
            yield lambda number=number: _filled_array(array, number), "not finite", True
    if name == "index" and len(array) > 1:
        yield lambda: np.repeat(array[:1], len(array)), "one keyframe again and again", True
    if name == "block_coords":
        yield lambda: _filled_array(array, 2**30), "very large", True
        yield lambda: np.repeat(array[:1], len(array), 0), "one block again and again", True
    if name == "observed":
        yield lambda: np.zeros_like(array), "other voxels", True
        yield lambda: array[:, :-1], "a column less", True
    if array.ndim > 1:
        yield lambda: array.T.copy(), "axes exchanged", True


def _filled_array(array: np.ndarray, number: float) -> np.ndarray:
    new = array.copy()
    new.reshape(-1)[new.size // 2] = number
    return new


def _stride(folder: Path, rng: random.Random) -> Alteration | None:
    """A tensor of the last state stands for more memory than it has; the checksum is made again."""
    (document,) = folder.glob("*.json")
    values = json.loads(document.read_text())
    name = next(name for name in values["files"] if name.endswith(".state"))
    state = torch.load(folder / name, weights_only=True)
    tensors = list(_tensors(state, ()))
    if not tensors:
        return None
    *way, last = rng.choice(tensors)
    holder = state
    for key in way:
        holder = holder[key]
    holder[last] = torch.zeros(1).expand(40_000_000, 64)
    torch.save(state, folder / name)
    values["files"][name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    document.write_text(json.dumps(values))
    return Alteration("/".join(map(str, (*way, last))), "a stride of 0", True)


def _tensors(value: Any, way: Way) -> Iterator[Way]:
    if isinstance(value, Tensor):
        yield way
    for key, part in (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    ):
        yield from _tensors(part, (*way, key))
