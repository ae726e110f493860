"""Record3D (iPhone, iPad): a .r3d archive, its unpacked folder, or the "EXR + JPG sequence" export.

.r3d is a zip with ``metadata`` (JSON) and rgbd/N.jpg, N.depth, N.conf; depth is float32 metres and confidence uint8,
both packed with Apple's LZFSE and smaller than colour. Poses ``qx qy qz qw tx ty tz`` are camera-to-world with ARKit's
axes (OpenGL: y up, z backward). Intrinsics are column-major ``K``, or fx fy cx cy per frame, at the colour's size, from
the corner of the image.
"""

import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ...lens.camera_model import CameraModel
from ...recorded.images import read_image_bytes
from ...recorded.poses import matrices
from ...sequence import BadFrameError, SequenceError, SequenceNotFoundError
from ..intrinsics import model_of
from ..options import ConvertOptions
from ..pictures import load_pair, metres, with_colour
from ..recording import Pictures, Recording, Shot

_GL_TO_CV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
_SIZES = ((192, 256), (256, 192), (640, 480), (480, 640))
"""Heights and widths of LiDAR and TrueDepth images, for files that do not say."""

Fetch = Callable[[str], bytes]
"""Content of a member of the archive, by name."""


def recognise(path: Path) -> bool:
    """The archive, or a folder with metadata and rgbd/, or the export with EXR."""
    if path.is_file():
        return path.suffix.lower() == ".r3d"
    return _metadata_file(path) is not None and any((path / n).is_dir() for n in ("rgbd", "rgb"))


def read(path: Path, options: ConvertOptions) -> Recording:
    """A capture of Record3D (module docstring)."""
    if path.is_file():
        archive = _archive(path)
        names, fetch = set(archive.namelist()), partial(_member, archive, path)
        metadata = _object(fetch("metadata"), f"{path}: metadata")
    else:
        file = _metadata_file(path)
        if file is None:
            raise SequenceNotFoundError(f"{path} lacks metadata.json; expected an unpacked .r3d or the EXR export")
        names = {str(p.relative_to(path)) for p in path.glob("rgb*/*")}
        fetch = partial(_file, path)
        metadata = _object(file.read_bytes(), str(file))
    exported = not any(n.startswith("rgbd/") for n in names)
    pattern = "rgb/" if exported else "rgbd/"
    numbers = sorted(int(Path(n).stem) for n in names if n.startswith(pattern) and n.endswith(".jpg"))
    poses = _poses(metadata, len(numbers), path)

    def shots() -> Iterator[Shot]:
        for i, number in enumerate(numbers):
            name = f"{pattern}{number}"
            if exported:
                load = partial(load_pair, path / f"rgb/{number}.jpg", path / f"depth/{number}.exr", 1.0)
            else:
                load = partial(_load, fetch, name, metadata, options.confidence, f"{path}: {name}")
            yield Shot(
                source=f"{path}: {name}",
                time_s=_time(metadata, i),
                model=_model(metadata, i, path),
                T_WC=None if poses is None else poses[i],
                load=load,
            )

    if not numbers:
        raise SequenceError(f"{path} holds no frames; expected {pattern}0.jpg and so on")
    note = "confidence is not in this export" if exported else f"depth of confidence {options.confidence} and above"
    return Recording(
        name=str(path), shots=shots, n_shots=len(numbers), depth_scale=1.0, has_poses=poses is not None, notes=(note,)
    )


def lzfse_unpacked(data: bytes, source: str) -> bytes:
    """Content of an LZFSE stream; blocks that are stored as they are need no library.

    Raises:
        SequenceError: it is really packed, and the package ``pyliblzfse`` is missing. BadFrameError: it is damaged.
    """
    out, at = b"", 0
    while data[at : at + 4] == b"bvx-" and len(data) >= at + 8:
        (n,) = struct.unpack_from("<I", data, at + 4)
        out += data[at + 8 : at + 8 + n]
        at += 8 + n
    if out and data[at : at + 4] == b"bvx$":
        return out
    if data[:3] != b"bvx":
        raise BadFrameError(f"{source} does not begin as LZFSE does; expected the bytes bvx")
    try:
        import liblzfse  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise SequenceError(
            f"{source} is packed with Apple's LZFSE, which needs the package pyliblzfse: pip install pyliblzfse"
        ) from None
    try:
        return liblzfse.decompress(data)
    except liblzfse.error as e:
        raise BadFrameError(f"{source} is damaged: LZFSE cannot unpack it ({e})") from None


def _load(fetch: Fetch, name: str, metadata: dict[str, Any], least: int, source: str) -> Pictures:
    packed = lzfse_unpacked(fetch(f"{name}.depth"), f"{source}.depth")
    if len(packed) % 4:
        raise BadFrameError(f"{source}.depth unpacks to {len(packed)} bytes; expected float32 numbers")
    values = np.frombuffer(packed, "<f4")
    depth_m = metres(values.reshape(_depth_size(metadata, len(values), f"{source}.depth")), 1.0)
    if least > 0:
        try:
            confidence = np.frombuffer(lzfse_unpacked(fetch(f"{name}.conf"), f"{source}.conf"), np.uint8)
        except BadFrameError:  # TrueDepth captures have none
            confidence = None
        if confidence is not None and confidence.size == depth_m.size:
            depth_m[confidence.reshape(depth_m.shape) < least] = 0.0
    return with_colour(fetch(f"{name}.jpg"), f"{source}.jpg", depth_m)


def _depth_size(metadata: dict[str, Any], n: int, source: str) -> tuple[int, int]:
    size = (int(metadata.get("dh", 0)), int(metadata.get("dw", 0)))
    if size[0] * size[1] == n:
        return size
    portrait = metadata.get("h", 1) > metadata.get("w", 0)
    found = next((s for s in _SIZES if s[0] * s[1] == n and (s[0] > s[1]) == portrait), None)
    if found is None:
        raise BadFrameError(f"{source} unpacks to {n} numbers; expected dw x dh = {size[1]}x{size[0]} of the metadata")
    return found


def _poses(metadata: dict[str, Any], n: int, path: Path) -> Float[Tensor, "N 4 4"] | None:
    rows = metadata.get("poses")
    if not rows:
        return None
    table = torch.tensor(rows, dtype=torch.float64)
    if table.ndim != 2 or table.shape[1] != 7 or len(table) < n:
        raise SequenceError(
            f"{path}: poses of the metadata are {list(table.shape)}; expected {n} rows qx qy qz qw tx ty tz"
        )
    return matrices(table[:, [4, 5, 6, 0, 1, 2, 3]]) @ _GL_TO_CV


def _model(metadata: dict[str, Any], i: int, path: Path) -> CameraModel:
    try:
        size = (int(metadata["w"]), int(metadata["h"]))
        frames = metadata.get("perFrameIntrinsicCoeffs") or []
        K = metadata["K"] if i >= len(frames) else None
        values = [float(v) for v in (frames[i][:4] if K is None else (K[0], K[4], K[6], K[7]))]
    except (KeyError, TypeError, IndexError, ValueError) as e:
        raise SequenceError(
            f"{path}: the metadata lack {e}; expected w, h and K of 9 numbers, column by column"
        ) from None
    return model_of(values, size, f"{path}: the metadata", centre=0.5)


def _time(metadata: dict[str, Any], i: int) -> float:
    stamps = metadata.get("frameTimestamps") or []
    return float(stamps[i]) if i < len(stamps) else i / float(metadata.get("fps", 30))


def _metadata_file(path: Path) -> Path | None:
    return next((p for p in (path / "metadata", path / "metadata.json") if p.is_file()), None)


def _object(data: bytes, source: str) -> dict[str, Any]:
    try:
        values = json.loads(data)
    except (json.JSONDecodeError, UnicodeDecodeError) as e:
        raise SequenceError(f"{source} is not valid JSON ({e}); expected Record3D's metadata") from None
    if not isinstance(values, dict):
        raise SequenceError(f"{source} must hold a JSON object with w, h, K and poses")
    return values


def _archive(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except zipfile.BadZipFile as e:
        raise SequenceError(f"{path} is not an .r3d archive or is truncated ({e}); export it again") from None


def _member(archive: zipfile.ZipFile, path: Path, name: str) -> bytes:
    try:
        return archive.read(name)
    except KeyError:
        error = SequenceError if name == "metadata" else BadFrameError
        raise error(f"{path} lacks {name}; expected it in a .r3d archive") from None
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError) as e:
        raise BadFrameError(f"{path}: {name} is damaged ({e})") from None


def _file(root: Path, name: str) -> bytes:
    return read_image_bytes(root / name, "Record3D")
