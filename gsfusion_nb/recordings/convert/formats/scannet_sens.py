"""ScanNet's .sens container (version 4), little-endian: JPEG colour and zlib-packed 16-bit depth, frame after frame.

uint32 version, uint64 length + sensor name, 4 matrices of 16 floats (colour intrinsic, extrinsic; depth intrinsic,
extrinsic), int32 colour and depth compression, uint32 colour and depth sizes, float depth units per metre, uint64
frames; then per frame 16 floats of pose, uint64 times in microseconds, uint64 byte counts, and the bytes.
"""

import math
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ....data.lens.camera_model import CameraModel
from ....data.sequence import BadFrameError, SequenceError
from ....foreign import inflate, open_regular, read_exactly
from ....geometry import se3
from ..image_files import metres, with_colour
from ..intrinsics import model_of_matrix
from ..options import ConvertOptions
from ..recording import RecordedFrame, Recording, RgbdImages

FRAMES_PER_S = 30.0
"""Of exported scans, whose files hold no times."""

_VERSION = 4
_COLOUR = {0: "raw", 1: "png", 2: "jpeg"}
_DEPTH = {0: "raw_ushort", 1: "zlib_ushort", 2: "occi_ushort"}
_FRAME = struct.Struct("<16f4Q")


@dataclass(frozen=True, eq=False)
class _Header:
    colour: CameraModel
    depth: CameraModel
    extrinsic_colour: Float[Tensor, "4 4"]
    extrinsic_depth: Float[Tensor, "4 4"]
    compression: str
    """Of depth."""
    units_per_m: float
    n_frames: int
    frames_at: int
    """Place of the first frame, bytes."""


def read(path: Path, options: ConvertOptions) -> Recording:
    """Frames of a .sens file, one in memory at a time.

    Raises:
        SequenceError: another version, an unknown compression, or a truncated header.
    """
    with open_regular(path, "a ScanNet .sens file") as file:
        header = _read_header(file, path)
    scale = options.depth_scale or header.units_per_m
    T_colour_depth, T_rig_colour = registration(header.extrinsic_colour, header.extrinsic_depth)

    def recorded_frames() -> Iterator[RecordedFrame]:
        with open_regular(path, "a ScanNet .sens file") as file:
            size = os.fstat(file.fileno()).st_size
            file.seek(header.frames_at)
            for i in range(header.n_frames):
                head = file.read(_FRAME.size)
                if len(head) < _FRAME.size:
                    raise SequenceError(
                        f"{path} is truncated: it ends at frame {i} of {header.n_frames}; download it again"
                    )
                *pose, colour_us, _, colour_bytes, depth_bytes = _FRAME.unpack(head)
                source = f"{path} frame {i}"
                if colour_bytes + depth_bytes > size - file.tell():
                    raise SequenceError(
                        f"{path} is truncated: it ends at frame {i} of {header.n_frames}; download it again"
                    )
                data = file.read(colour_bytes), file.read(depth_bytes)
                yield RecordedFrame(
                    source=source,
                    time_s=colour_us / 1e6 if colour_us else i / FRAMES_PER_S,
                    model=header.colour,
                    depth_model=header.depth,
                    T_colour_depth=T_colour_depth,
                    T_WC=torch.tensor(pose, dtype=torch.float64).reshape(4, 4) @ T_rig_colour,
                    load=partial(_load, data, header, scale, source),
                )

    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=header.n_frames,
        depth_scale=scale,
        notes=(f"depth read as {scale:g} per metre",),
    )


def registration(
    T_rig_colour: Float[Tensor, "4 4"], T_rig_depth: Float[Tensor, "4 4"]
) -> tuple[Float[Tensor, "4 4"] | None, Float[Tensor, "4 4"]]:
    """From depth camera to colour camera (None if they are one), and from colour camera to the posed rig."""
    T = se3.inverse(T_rig_colour) @ T_rig_depth
    return (None if torch.allclose(T, torch.eye(4, dtype=T.dtype), atol=1e-5) else T), T_rig_colour


def _read_header(file: BinaryIO, path: Path) -> _Header:
    version, length = struct.unpack("<IQ", read_exactly(file, 12, path))
    if version != _VERSION or length > 4096:
        raise SequenceError(
            f"{path} begins with version {version}; expected a ScanNet .sens file of version {_VERSION}"
        )
    read_exactly(file, length, path)
    matrices = [list(struct.unpack("<16f", read_exactly(file, 64, path))) for _ in range(4)]
    colour, depth = struct.unpack("<ii", read_exactly(file, 8, path))
    if _COLOUR.get(colour) not in ("jpeg", "png") or _DEPTH.get(depth) not in ("zlib_ushort", "raw_ushort"):
        raise SequenceError(
            f"{path} packs colour as {_COLOUR.get(colour, colour)} and depth as {_DEPTH.get(depth, depth)}; expected "
            "jpeg or png, and zlib_ushort or raw_ushort"
        )
    *sizes, units, n_frames = struct.unpack("<4IfQ", read_exactly(file, 28, path))
    if not 0 < units < math.inf:
        raise SequenceError(f"{path} says that one metre is {units} in depth; expected a number above 0")
    room = os.fstat(file.fileno()).st_size - file.tell()
    if n_frames * _FRAME.size > room:
        raise SequenceError(f"{path} claims {n_frames} frames and has {room} bytes for them; download it again")
    extrinsic_colour, extrinsic_depth = (torch.tensor(matrices[i], dtype=torch.float64).reshape(4, 4) for i in (1, 3))
    return _Header(
        model_of_matrix(matrices[0], (sizes[0], sizes[1]), f"{path}: colour intrinsics", centre=0.0),
        model_of_matrix(matrices[2], (sizes[2], sizes[3]), f"{path}: depth intrinsics", centre=0.0),
        extrinsic_colour,
        extrinsic_depth,
        _DEPTH[depth],
        units,
        n_frames,
        file.tell(),
    )


def _load(data: tuple[bytes, bytes], header: _Header, scale: float, source: str) -> RgbdImages:
    camera = header.depth.camera
    packed = data[1]
    if header.compression == "zlib_ushort":
        packed = inflate(packed, f"{source}: depth", at_most=2 * camera.width * camera.height)
    if len(packed) != 2 * camera.width * camera.height:
        raise BadFrameError(
            f"{source}: depth has {len(packed)} bytes; expected {camera.width}x{camera.height} of 2 each"
        )
    raw = np.frombuffer(packed, "<u2").reshape(camera.height, camera.width)
    return with_colour(data[0], source, metres(raw, scale))
