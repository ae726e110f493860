"""ScanNet: a .sens file, or the folders that its exporter makes (color/, depth/, pose/,
intrinsic/).

Poses are camera-to-world with OpenCV axes, -inf where tracking was lost. Depth is in millimetres (a
.sens file holds its own scale); depth images are smaller than colour and have their own intrinsics;
pixel centres at integers.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ....data.lens import CameraModel
from ....data.recorded.files import images_in
from ....data.recorded.poses import image_number
from ....errors import BadFrameError, SequenceError, SequenceNotFoundError
from ....files import inflate, open_regular, read_exactly
from ....geometry import se3
from ..camera_numbers import model_of_matrix
from ..depth_files import find_depth, metres
from ..recording import ConvertOptions, RecordedFrame, Recording, RgbdImages, with_colour
from .image_recording import recording_of
from .pairing import FrameFiles

LOOKS_FOR = "a .sens file, or a folder with color/, depth/, pose/ and intrinsic/"


def recognise(path: Path) -> bool:
    """A .sens file, a folder with one, or the exported folders."""
    return path.suffix == ".sens" or _sens_in(path) is not None or _root(path) is not None


def read(path: Path, options: ConvertOptions) -> Recording:
    """A .sens file or an exported scan (module docstring)."""
    sens = path if path.is_file() else _sens_in(path)
    root = _root(path)
    if root is None:
        if sens is None:
            raise SequenceNotFoundError(
                f"{path} holds neither a .sens file nor color/, depth/ and pose/"
            )
        return read_sens(sens, options)
    pairs = [
        (colour, find_depth(root / "depth", colour.stem)) for colour in images_in(root / "color")
    ]
    # a missing image must not shift the later times
    numbers = [image_number(colour) for colour, _ in pairs]
    times_s = [(place if n is None else n) / FRAMES_PER_S for place, n in enumerate(numbers)]
    options = replace(options, depth_scale=options.depth_scale or 1000.0)
    note = (
        f"depth read as {options.depth_scale:g} per metre; times are frame numbers at "
        f"{FRAMES_PER_S:g} Hz"
    )
    return recording_of(root, FrameFiles(pairs, times_s, notes=(note,)), options)


def _sens_in(path: Path) -> Path | None:
    return next(iter(sorted(path.glob("*.sens"))), None) if path.is_dir() else None


def _root(path: Path) -> Path | None:
    names = ("color", "depth", "pose")
    places = (path, path / "frames", path / "exported") if path.is_dir() else ()
    roots = (p for p in places if all((p / n).is_dir() for n in names))
    return next((p for p in roots if next(p.glob("intrinsic*"), None)), None)


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


def read_sens(path: Path, options: ConvertOptions) -> Recording:
    """Frames of a .sens file, one in memory at a time.

    Raises:
        SequenceError: another version, an unknown compression, or a truncated header.
    """
    with open_regular(path, "a ScanNet .sens file") as file:
        header = _read_header(file, path)
    scale = options.depth_scale or header.units_per_m
    T_rig_colour = header.extrinsic_colour
    T_colour_depth = se3.inverse(T_rig_colour) @ header.extrinsic_depth
    is_one_camera = torch.allclose(
        T_colour_depth,
        torch.eye(4, dtype=torch.float64),
        atol=1e-5,
    )

    def recorded_frames() -> Iterator[RecordedFrame]:
        with open_regular(path, "a ScanNet .sens file") as file:
            file.seek(header.frames_at)
            for i in range(header.n_frames):
                *pose, colour_us, _, colour_bytes, depth_bytes = _FRAME.unpack(
                    read_exactly(file, _FRAME.size, path)
                )
                source = f"{path} frame {i}"
                data = read_exactly(file, colour_bytes, path), read_exactly(file, depth_bytes, path)
                yield RecordedFrame(
                    source=source,
                    time_s=colour_us / 1e6 if colour_us else i / FRAMES_PER_S,
                    model=header.colour,
                    depth_model=header.depth,
                    T_colour_depth=None if is_one_camera else T_colour_depth,
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


def _read_header(file: BinaryIO, path: Path) -> _Header:
    version, length = struct.unpack("<IQ", read_exactly(file, 12, path))
    if version != _VERSION or length > 4096:
        raise SequenceError(
            f"{path} begins with version {version}; expected a ScanNet .sens file of version "
            f"{_VERSION}"
        )
    read_exactly(file, length, path)
    matrices = [list(struct.unpack("<16f", read_exactly(file, 64, path))) for _ in range(4)]
    colour, depth = struct.unpack("<ii", read_exactly(file, 8, path))
    if _COLOUR.get(colour) not in ("jpeg", "png") or _DEPTH.get(depth) not in (
        "zlib_ushort",
        "raw_ushort",
    ):
        raise SequenceError(
            f"{path} packs colour as {_COLOUR.get(colour, colour)} and depth as "
            f"{_DEPTH.get(depth, depth)}; expected jpeg or png, and zlib_ushort or raw_ushort"
        )
    *sizes, units, n_frames = struct.unpack("<4IfQ", read_exactly(file, 28, path))
    if not 0 < units < math.inf:
        raise SequenceError(
            f"{path} says that one metre is {units} in depth; expected a number above 0"
        )
    extrinsic_colour, extrinsic_depth = (
        torch.tensor(matrices[i], dtype=torch.float64).reshape(4, 4) for i in (1, 3)
    )
    return _Header(
        model_of_matrix(
            matrices[0], (sizes[0], sizes[1]), f"{path}: colour intrinsics", centre=0.0
        ),
        model_of_matrix(matrices[2], (sizes[2], sizes[3]), f"{path}: depth intrinsics", centre=0.0),
        extrinsic_colour,
        extrinsic_depth,
        _DEPTH[depth],
        units,
        n_frames,
        file.tell(),
    )


def _load(
    data: tuple[bytes, bytes],
    header: _Header,
    scale: float,
    source: str,
) -> RgbdImages:
    camera = header.depth.camera
    depth_bytes = data[1]
    if header.compression == "zlib_ushort":
        depth_bytes = inflate(
            depth_bytes, f"{source}: depth", at_most=2 * camera.width * camera.height
        )
    if len(depth_bytes) != 2 * camera.width * camera.height:
        raise BadFrameError(
            f"{source}: depth has {len(depth_bytes)} bytes; expected "
            f"{camera.width}x{camera.height} of 2 each"
        )
    raw = np.frombuffer(depth_bytes, "<u2").reshape(camera.height, camera.width)
    return with_colour(data[0], source, metres(raw, scale))
