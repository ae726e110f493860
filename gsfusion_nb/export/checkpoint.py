"""Saving the state of a run so that it can continue later. Nothing in the file is executed when it is read."""

import zipfile
from pathlib import Path
from typing import Any

import torch

from ..errors import SequenceError
from ..files import atomic_file
from ..foreign import open_archive, parsing

FORMAT = "gsfusion_nb checkpoint"
VERSION = 1


def save_checkpoint(path: str | Path, state: dict[str, Any]) -> None:
    """Write nested dictionaries, lists and tuples of tensors, numbers, strings and None, atomically.

    Tensors are stored detached and on the CPU; of a view, only its own elements are stored.

    Raises:
        TypeError: another type in ``state``; the message names the key.
    """
    content = {"format": FORMAT, "version": VERSION, "state": _plain(state, "state")}
    with atomic_file(path) as temporary:
        torch.save(content, temporary)


def load_checkpoint(path: str | Path, *, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a file written by ``save_checkpoint``, with the tensors on ``device``.

    Raises:
        FileNotFoundError: no such file. ValueError: a damaged file, another kind of file, or another format version.
    """
    path, what = Path(path), "a checkpoint"
    with open_archive(path, what) as archive, parsing(path, what):
        members = archive.infolist()
        claimed = sum(member.file_size for member in members)
        if claimed > path.stat().st_size or any(m.compress_type != zipfile.ZIP_STORED for m in members):
            raise SequenceError(f"{path} is damaged: its members are packed, or claim more bytes than it has")
        broken = archive.testzip()
        if broken:
            raise SequenceError(f"{path} is damaged: {broken} in it fails its checksum")
        content = torch.load(path, map_location=device, weights_only=True)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f"{path} is a PyTorch file but not a {FORMAT}; expected one written by save_checkpoint")
    if content.get("version") != VERSION:
        raise ValueError(
            f"{path} has checkpoint version {content.get('version')}; this program reads version {VERSION}"
        )
    return content["state"]


def _plain(value: Any, name: str) -> Any:
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu()
        whole = value.untyped_storage().nbytes() == value.numel() * value.element_size()
        return value if whole else value.clone()
    if value is None or type(value) in (bool, int, float, str):
        return value
    if type(value) is dict:
        for key in value:
            if type(key) not in (str, int):
                raise TypeError(f"{name} must have strings or integers as keys, got {key!r}")
        return {key: _plain(v, f"{name}[{key!r}]") for key, v in value.items()}
    if type(value) in (list, tuple):
        return type(value)(_plain(v, f"{name}[{i}]") for i, v in enumerate(value))
    raise TypeError(
        f"{name} must be a tensor, number, string, None, or a dict, list or tuple of those, got {type(value)}"
    )
