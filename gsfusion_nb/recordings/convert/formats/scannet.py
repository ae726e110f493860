"""ScanNet: a .sens file, or the folders that its exporter makes (color/, depth/, pose/, intrinsic/).

Poses are camera-to-world with OpenCV axes, -inf where tracking was lost. Depth is in millimetres (a .sens file holds
its own scale); depth images are smaller than colour and have their own intrinsics; pixel centres at integers.
"""

import math
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

from ....data.lens import CameraModel
from ....data.recorded.files import images_in
from ....data.recorded.images import read_rgb
from ....data.recorded.poses import image_number
from ....data.sequence import BadFrameError, SequenceError, SequenceNotFoundError
from ....files import inflate, open_regular, read_exactly
from ....geometry import se3
from ..camera import model_of_matrix
from ..recording import (
    ConvertOptions,
    RecordedFrame,
    Recording,
    RgbdImages,
    find_depth,
    load_pair,
    metres,
    read_depth_file,
    with_colour,
)
from ..trajectory import read_numbers

LOOKS_FOR = "a .sens file, or a folder with color/, depth/ and pose/"


def recognise(path: Path) -> bool:
    """A .sens file, a folder with one, or the exported folders."""
    return path.suffix == ".sens" or _sens_in(path) is not None or _root(path) is not None


def read(path: Path, options: ConvertOptions) -> Recording:
    """A .sens file or an exported scan (module docstring)."""
    sens = path if path.is_file() else _sens_in(path)
    root = _root(path)
    if root is None:
        if sens is None:
            raise SequenceNotFoundError(f"{path} holds neither a .sens file nor color/, depth/ and pose/")
        return read_sens(sens, options)
    colour = images_in(root / "color")
    scale = options.depth_scale or 1000.0
    models = {kind: _model(root, kind, colour) for kind in ("color", "depth")}

    def recorded_frames() -> Iterator[RecordedFrame]:
        for i, file in enumerate(colour):
            number = image_number(file)  # a missing image must not shift the times of the later ones
            depth = find_depth(root / "depth", file.stem)
            yield RecordedFrame(
                source=str(file),
                time_s=(i if number is None else number) / FRAMES_PER_S,
                model=models["color"],
                depth_model=models["depth"],
                T_WC=_pose(root / "pose" / f"{file.stem}.txt"),
                load=partial(load_pair, file, depth, scale),
            )

    return Recording(
        name=str(path),
        frames=recorded_frames,
        n_frames=len(colour),
        depth_scale=scale,
        notes=(f"depth read as {scale:g} per metre; times are frame numbers at {FRAMES_PER_S:g} Hz",),
    )


def _sens_in(path: Path) -> Path | None:
    return next(iter(sorted(path.glob("*.sens"))), None) if path.is_dir() else None


def _root(path: Path) -> Path | None:
    names = ("color", "depth", "pose")
    places = (path, path / "frames", path / "exported") if path.is_dir() else ()
    return next((p for p in places if all((p / n).is_dir() for n in names)), None)


def _model(root: Path, kind: str, colour: list[Path]) -> CameraModel:
    file = next((p for p in (root / "intrinsic", root) if (p / f"intrinsic_{kind}.txt").is_file()), None)
    if file is None:
        raise SequenceNotFoundError(f"{root} lacks intrinsic/intrinsic_{kind}.txt; expected a 4x4 matrix of the camera")
    file = file / f"intrinsic_{kind}.txt"
    depths = (find_depth(root / "depth", p.stem) for p in colour)
    first = colour[0] if kind == "color" else next((p for p in depths if p.is_file()), None)
    if first is None:
        raise SequenceError(f"{root / 'depth'} holds no depth image of any colour image; expected the same names")
    height, width = (read_rgb(first) if kind == "color" else read_depth_file(first, 1000.0)).shape[:2]
    return model_of_matrix(read_numbers(file, "a 4x4 matrix"), (width, height), str(file), centre=0.0)


def _pose(file: Path) -> Float[Tensor, "4 4"]:
    """A pose; NaN where the file is missing, empty or says -inf."""
    try:
        values = read_numbers(file, "a 4x4 matrix")
    except SequenceNotFoundError:
        values = []
    if len(values) != 16:
        return torch.full((4, 4), torch.nan, dtype=torch.float64)
    return torch.tensor(values, dtype=torch.float64).reshape(4, 4)


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
    is_one_camera = torch.allclose(T_colour_depth, torch.eye(4, dtype=torch.float64), atol=1e-5)

    def recorded_frames() -> Iterator[RecordedFrame]:
        with open_regular(path, "a ScanNet .sens file") as file:
            file.seek(header.frames_at)
            for i in range(header.n_frames):
                *pose, colour_us, _, colour_bytes, depth_bytes = _FRAME.unpack(read_exactly(file, _FRAME.size, path))
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
