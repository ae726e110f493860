"""ScanNet: a .sens file, or the folders that its exporter makes (color/, depth/, pose/, intrinsic/).

Poses are camera-to-world with OpenCV axes, -inf where tracking was lost. Depth is in millimetres (a .sens file holds
its own scale); depth images are smaller than colour and have their own intrinsics; pixel centres at integers.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ....data.lens.camera_model import CameraModel
from ....data.recorded.find_files import images_in
from ....data.recorded.images import read_image_bytes, read_rgb
from ....data.recorded.pose_lines import image_number
from ....data.sequence import SequenceError, SequenceNotFoundError
from ..image_files import decode_depth, find_depth, load_pair
from ..intrinsics import model_of_matrix
from ..options import ConvertOptions
from ..recording import RecordedFrame, Recording
from ..trajectory import read_numbers
from . import scannet_sens
from .scannet_sens import FRAMES_PER_S, registration


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
        return scannet_sens.read(sens, options)
    colour = images_in(root / "color")
    scale = options.depth_scale or 1000.0
    models = {kind: _model(root, kind, colour) for kind in ("color", "depth")}
    T_colour_depth, T_rig_colour = registration(_extrinsic(root, "color"), _extrinsic(root, "depth"))

    def recorded_frames() -> Iterator[RecordedFrame]:
        for i, file in enumerate(colour):
            number = image_number(file)  # a missing image must not shift the times of the later ones
            depth = find_depth(root / "depth", file.stem)
            yield RecordedFrame(
                source=str(file),
                time_s=(i if number is None else number) / FRAMES_PER_S,
                model=models["color"],
                depth_model=models["depth"],
                T_colour_depth=T_colour_depth,
                T_WC=_pose(root / "pose" / f"{file.stem}.txt") @ T_rig_colour,
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


def _file(root: Path, name: str) -> Path | None:
    return next((p for p in (root / "intrinsic" / name, root / name) if p.is_file()), None)


def _model(root: Path, kind: str, colour: list[Path]) -> CameraModel:
    file = _file(root, f"intrinsic_{kind}.txt")
    if file is None:
        raise SequenceNotFoundError(f"{root} lacks intrinsic/intrinsic_{kind}.txt; expected a 4x4 matrix of the camera")
    first = next((p for p in colour if kind == "color" or find_depth(root / "depth", p.stem).is_file()), None)
    if first is None:
        raise SequenceError(f"{root / 'depth'} holds no depth image of any colour image; expected the same names")
    if kind == "color":
        height, width = read_rgb(first).shape[:2]
    else:
        depth = find_depth(root / "depth", first.stem)
        height, width = decode_depth(read_image_bytes(depth, "depth"), str(depth), 1000.0).shape
    return model_of_matrix(read_numbers(file, "a 4x4 matrix"), (width, height), str(file), centre=0.0)


def _extrinsic(root: Path, kind: str) -> Float[Tensor, "4 4"]:
    file = _file(root, f"extrinsic_{kind}.txt")
    if file is None:
        return torch.eye(4, dtype=torch.float64)
    values = read_numbers(file, "a 4x4 matrix")
    if len(values) != 16:
        raise SequenceError(f"{file} must hold a 4x4 matrix, got {len(values)} numbers")
    return torch.tensor(values, dtype=torch.float64).reshape(4, 4)


def _pose(file: Path) -> Float[Tensor, "4 4"]:
    """A pose; NaN where the file is missing, empty or says -inf."""
    try:
        values = read_numbers(file, "a 4x4 matrix")
    except SequenceNotFoundError:
        values = []
    if len(values) != 16:
        return torch.full((4, 4), torch.nan, dtype=torch.float64)
    return torch.tensor(values, dtype=torch.float64).reshape(4, 4)
