"""What a run keeps so that another recording can go on in its map: the file ``state.zip``.

It has what no other file of the run has: keyframes with their images, the memory of the seeding
rule, random numbers, and of each Gaussian what is neither one of its parameters, which are in
``gaussians.ply``, nor a moment of Adam, which begin at zero again. The volume is in ``tsdf.npz``,
and what finds the camera in ``places.npz``.
"""

import io
import zipfile
from pathlib import Path
from typing import Any

import torch

from ..errors import ArgumentError, SequenceError, reason_of
from ..export.checkpoint_values import check_buffers, on_disk, plain_values
from ..files import atomic_file, check_memory, open_archive, parsing, read_member
from ..gaussians.columns import PARAMETERS
from ..gaussians.moments import MOMENTS
from ..mapping import Mapper
from .sound_state import check_values

STATE = "state.zip"
"""The file in a run's folder."""

_WHAT = "the state of a run's map, by which another recording goes on in it"
_MEMBER = "state.pt"
_FORMAT = "gsfusion_nb map state"
_VERSION = 1
_PARTS = (
    "rule",
    "training",
    "n_frames",
    "steps_taken",
    "n_not_finite",
    "random",
    "gaussians",
    "keyframes",
)
"""Parts of ``Mapper.state_dict``."""
_ELSEWHERE = (*PARAMETERS, *(moment + name for moment in MOMENTS for name in PARAMETERS))
"""Columns of the Gaussians that are not in the file."""
_FAST: dict[str, Any] = {"compression": zipfile.ZIP_DEFLATED, "compresslevel": 1}


def map_state(mapper: Mapper) -> dict[str, Any]:
    """What the file holds of a mapper."""
    state = mapper.state_dict(copies=False)
    parts = {name: state[name] for name in _PARTS}
    rows = parts["gaussians"]["rows"]
    parts["gaussians"] = parts["gaussians"] | {
        "rows": {name: column for name, column in rows.items() if name not in _ELSEWHERE}
    }
    localiser = state["localiser"]
    return parts | {"poses": localiser["poses"], "frame_indices": localiser["frame_indices"]}


def write_map_state(path: str | Path, mapper: Mapper) -> None:
    """Write what is needed to go on in the map of a mapper, atomically."""
    document = {
        "format": _FORMAT,
        "version": _VERSION,
        "state": plain_values(map_state(mapper), "state", on_disk),
    }
    with (
        atomic_file(path) as temporary,
        zipfile.ZipFile(temporary, "w", **_FAST) as archive,
        archive.open(_MEMBER, "w", force_zip64=True) as file,
    ):
        torch.save(document, file)


def read_map_state(path: str | Path) -> dict[str, Any]:
    """The state that ``write_map_state`` wrote. No code from the file is executed.

    Raises:
        FileNotFoundError: no such file. ValueError: another file, or a damaged one.
    """
    path = Path(path)
    with open_archive(path, _WHAT) as archive, parsing(path, _WHAT):
        size = archive.getinfo(_MEMBER).file_size
        check_memory(path, size, _WHAT)
        content = read_member(archive, _MEMBER, path, at_most=size)
        document = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        check_buffers(document, path.name)
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        raise SequenceError(f"{path} is not {_WHAT}")
    if document.get("version") != _VERSION:
        raise SequenceError(
            f"{path} is of version {document.get('version')!r}, expected {_VERSION}: map the "
            "recording of the run again"
        )
    state = document.get("state")
    if not isinstance(state, dict) or set(state) != {*_PARTS, "poses", "frame_indices"}:
        raise SequenceError(f"{path} does not hold the parts of {_WHAT}")
    try:
        check_values(state)
    except SequenceError as e:
        raise SequenceError(f"{path}: {e}") from None
    except Exception as e:  # values of other types than any run writes
        raise ArgumentError(f"{path} is damaged: {reason_of(e)}") from None
    return state
