"""Record3D (iPhone, iPad): a .r3d archive, its unpacked folder, or the "EXR + JPG sequence" export.

.r3d is a zip with ``metadata`` (JSON) and rgbd/N.jpg, N.depth, N.conf; depth is float32 metres and
confidence uint8, both packed with Apple's LZFSE and smaller than colour. Poses
``qx qy qz qw tx ty tz`` are camera-to-world with ARKit's axes (OpenGL: y up, z backward).
Intrinsics are column-major ``K``, or fx fy cx cy per frame, at the colour's size, from the corner
of the image.
"""

import re
import struct
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ....data.lens import CameraModel
from ....data.recorded.files import number
from ....data.recorded.images import read_image_bytes
from ....data.recorded.poses import GL_TO_CV, matrices
from ....errors import BadFrameError, SequenceError, SequenceNotFoundError
from ....files import (
    IMAGE_BYTES,
    TEXT_BYTES,
    open_archive,
    parse_json,
    parsing,
    read_bytes,
    read_member,
)
from ..camera_numbers import model_of
from ..depth_files import check_exr, metres
from ..recording import ConvertOptions, RecordedFrame, Recording, RgbdImages, load_pair, with_colour

_SIZES = ((192, 256), (256, 192), (640, 480), (480, 640))
"""Heights and widths of LiDAR and TrueDepth images, for files without this information."""

Fetch = Callable[[str], bytes]
"""Content of a member of the archive, by name."""

LOOKS_FOR = "a .r3d file, or its unpacked folder, or the EXR export"


def recognise(path: Path) -> bool:
    """The archive, or a folder with metadata and rgbd/, or the export with EXR."""
    if path.is_file():
        return path.suffix.lower() == ".r3d"
    return _metadata_file(path) is not None and any((path / n).is_dir() for n in ("rgbd", "rgb"))


def read(path: Path, options: ConvertOptions) -> Recording:
    """A capture of Record3D (module docstring)."""
    if path.is_file():
        archive = open_archive(path, "an .r3d archive")
        names = set(archive.namelist())
        fetch = partial(_member, archive, path)
        metadata = _object(fetch("metadata"), f"{path}: metadata")
    else:
        file = _metadata_file(path)
        if file is None:
            raise SequenceNotFoundError(
                f"{path} lacks metadata.json; expected an unpacked .r3d or the EXR export"
            )
        names = {str(p.relative_to(path)) for p in path.glob("rgb*/*")}
        fetch = partial(_file, path)
        metadata = _object(read_bytes(file, "Record3D's metadata"), str(file))
    is_export = not any(n.startswith("rgbd/") for n in names)
    pattern = "rgb/" if is_export else "rgbd/"
    matches = (re.fullmatch(pattern + r"(\d{1,9})\.jpg", n) for n in names)
    numbers = sorted({int(match[1]) for match in matches if match})
    if is_export and numbers:
        check_exr(path / f"depth/{numbers[0]}.exr")
    poses = _poses(metadata, 1 + max(numbers, default=-1), path)

    def recorded_frames() -> Iterator[RecordedFrame]:
        for n in numbers:  # the place in the metadata's lists: a missing image must not shift them
            name = f"{pattern}{n}"
            if is_export:
                load = partial(load_pair, path / f"rgb/{n}.jpg", path / f"depth/{n}.exr", 1.0)
            else:
                load = partial(_load, fetch, name, metadata, options.confidence, f"{path}: {name}")
            yield RecordedFrame(
                source=f"{path}: {name}",
                time_s=_time(metadata, n, path),
                model=_model(metadata, n, path),
                T_WC=None if poses is None else poses[n],
                load=load,
            )

    if not numbers:
        layout_text = (
            "rgbd/0.jpg" if path.is_file() else "rgbd/0.jpg, or rgb/0.jpg of the EXR export,"
        )
        raise SequenceError(f"{path} holds no frames; expected {layout_text} and so on")
    note = (
        "confidence is not in this export"
        if is_export
        else f"depth of confidence {options.confidence} and above"
    )
    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(numbers),
        depth_scale=1.0,
        has_poses=poses is not None,
        notes=(note, *_notes_on_short_lists(metadata, 1 + numbers[-1])),
    )


def lzfse_unpacked(data: bytes, source: str) -> bytes:
    """Content of an LZFSE stream; uncompressed blocks need no library.

    Raises:
        SequenceError: it is compressed, and the package ``pyliblzfse`` is missing. BadFrameError:
            it is damaged.
    """
    blocks = []
    at = 0
    while data[at : at + 4] == b"bvx-" and len(data) >= at + 8:
        (n,) = struct.unpack_from("<I", data, at + 4)
        blocks.append(data[at + 8 : at + 8 + n])
        at += 8 + n
    if blocks and data[at : at + 4] == b"bvx$":
        return b"".join(blocks)
    if data[:3] != b"bvx":
        raise BadFrameError(f"{source} does not begin like LZFSE data; expected the bytes bvx")
    try:
        import liblzfse  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise SequenceError(
            f"{source} is packed with Apple's LZFSE, which needs the package pyliblzfse: pip "
            "install pyliblzfse"
        ) from None
    with parsing(source, "an LZFSE stream", BadFrameError):
        return liblzfse.decompress(data)


def _load(
    fetch: Fetch,
    name: str,
    metadata: dict[str, Any],
    least: int,
    source: str,
) -> RgbdImages:
    raw_depth = lzfse_unpacked(fetch(f"{name}.depth"), f"{source}.depth")
    values = np.frombuffer(raw_depth, "<f4")
    depth_m = metres(values.reshape(_depth_size(metadata, len(values), f"{source}.depth")), 1.0)
    if least > 0:
        try:
            confidence = np.frombuffer(
                lzfse_unpacked(fetch(f"{name}.conf"), f"{source}.conf"), np.uint8
            )
        except BadFrameError:  # TrueDepth captures have none
            confidence = None
        if confidence is not None and confidence.size == depth_m.size:
            depth_m[confidence.reshape(depth_m.shape) < least] = 0.0
    return with_colour(fetch(f"{name}.jpg"), f"{source}.jpg", depth_m)


def _depth_size(
    metadata: dict[str, Any],
    n: int,
    source: str,
) -> tuple[int, int]:
    size = (int(number(metadata, "dh", 0, source)), int(number(metadata, "dw", 0, source)))
    if min(size) > 0 and size[0] * size[1] == n:
        return size
    portrait = number(metadata, "h", 1, source) > number(metadata, "w", 0, source)
    first_match = next(
        (s for s in _SIZES if s[0] * s[1] == n and (s[0] > s[1]) == portrait),
        None,
    )
    if first_match is None:
        raise BadFrameError(
            f"{source} unpacks to {n} numbers; expected dw x dh = {size[1]}x{size[0]} of the "
            "metadata"
        )
    return first_match


def _poses(
    metadata: dict[str, Any],
    n: int,
    path: Path,
) -> Float[Tensor, "N 4 4"] | None:
    rows = metadata.get("poses")
    if not rows:
        return None
    with parsing(f"{path}: poses of the metadata", "rows qx qy qz qw tx ty tz"):
        poses = torch.tensor(rows, dtype=torch.float64)
    if poses.ndim != 2 or poses.shape[1] != 7 or len(poses) < n:
        raise SequenceError(f"{path}: poses of the metadata must be {n} rows qx qy qz qw tx ty tz")
    has_rotation = (poses[:, :4] != 0).any(dim=1)  # some captures hold zeros, which are no rotation
    if not bool(has_rotation.any()):
        return None
    T_WC = matrices(poses[:, [4, 5, 6, 0, 1, 2, 3]]) @ GL_TO_CV
    return T_WC.where(has_rotation[:, None, None], torch.nan)


def _model(metadata: dict[str, Any], i: int, path: Path) -> CameraModel:
    with parsing(path, "metadata with w, h and K of 9 numbers, column by column"):
        size = (int(metadata["w"]), int(metadata["h"]))
        frames = metadata.get("perFrameIntrinsicCoeffs") or []
        K = metadata["K"] if i >= len(frames) else None
        fx, fy, cx, cy = (
            float(v) for v in (frames[i][:4] if K is None else (K[0], K[4], K[6], K[7]))
        )
    return model_of([fx, fy, cx, cy], size, f"{path}: the metadata", centre=0.5)


def _time(metadata: dict[str, Any], i: int, path: Path) -> float | None:
    """When a frame was taken; None where others have a time and it has none."""
    stamps = metadata.get("frameTimestamps") or []
    if stamps:
        return float(stamps[i]) if i < len(stamps) else None
    return i / number(metadata, "fps", 30, f"{path}: the metadata")


def _notes_on_short_lists(metadata: dict[str, Any], n: int) -> list[str]:
    """What is said about lists of the metadata that end before the last of ``n`` frames."""
    meanings = {
        "perFrameIntrinsicCoeffs": "the others have the intrinsics K",
        "frameTimestamps": "the others have no time",
    }
    return [
        f"{name} is of the first {len(metadata[name])} of {n} frames: {meaning}"
        for name, meaning in meanings.items()
        if 0 < len(metadata.get(name) or []) < n
    ]


def _metadata_file(path: Path) -> Path | None:
    return next(
        (p for p in (path / "metadata", path / "metadata.json") if p.is_file()),
        None,
    )


def _object(data: bytes, source: str) -> dict[str, Any]:
    with parsing(source, "Record3D's metadata as JSON"):
        values = parse_json(data.decode("utf-8-sig"), source, "Record3D's metadata")
    if not isinstance(values, dict):
        raise SequenceError(f"{source} must hold a JSON object with w, h, K and poses")
    return values


def _member(archive: zipfile.ZipFile, path: Path, name: str) -> bytes:
    try:
        return read_member(
            archive, name, path, at_most=TEXT_BYTES if name == "metadata" else IMAGE_BYTES
        )
    except KeyError:
        error = SequenceError if name == "metadata" else BadFrameError
        raise error(f"{path} lacks {name}; expected it in a .r3d archive") from None


def _file(root: Path, name: str) -> bytes:
    return read_image_bytes(root / name, "Record3D")
