"""ScanNet++ (Yeshwanth et al. 2023): DSLR images, undistorted, with depth rendered from the laser
scan.

    <scene>/dslr/
      nerfstudio/transforms_undistorted.json     or transforms_undistorted_2.json (half resolution)
      undistorted_images/DSC00001.JPG            or undistorted_images_2/
      undistorted_depths/DSC00001.png            or undistorted_depths_2/     16-bit, 1000 per metre
      train_test_lists.json                      {"train": ["DSC00001.JPG", ...], "test": [...]}

The data set holds no depth for these images: render it from the scan's mesh with the ScanNet++
toolbox, then undistort it. The world is that of the JSON, which has the mesh's x and y swapped and
z negated.
"""

import logging
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...errors import SequenceError, SequenceNotFoundError
from ...files import is_file, parsing, read_object
from ...types import Camera
from ..recorded.files import camera, require
from ..recorded.poses import GL_TO_CV
from ..recorded.recorded_sequence import Layout, RecordedSequence

log = logging.getLogger(__name__)

LOOKS_FOR = ("nerfstudio/transforms_undistorted*.json", "train_test_lists.json")
DEPTH_SCALE = 1000.0
_SUFFIX = {"half": "_2", "full": ""}


def scannetpp(
    path: str | Path, *, split: str = "all", resolution: str = "auto"
) -> RecordedSequence:
    """Read a ScanNet++ scene in the nerfstudio layout (module docstring).

    Depth scale: 1000 per metre. Poses: ``transform_matrix`` is camera-to-world with OpenGL axes (y
    up, z backward); it is converted to OpenCV axes by C2W diag(1, -1, -1, 1). Pixel centres: at (i
    + 0.5, j + 0.5) already (COLMAP), so nothing is added. Intrinsics, image size included, come
    from the JSON. Frames are in the order of ``train_test_lists.json``.

    Args:
        path: Folder of the scene, or its ``dslr`` folder.
        split: "train", "test", or "all": the training frames, then the test frames, which are
            marked as novel views.
        resolution: "half" reads the ``_2`` variant, "full" the other; "auto" prefers "half", as
            GSFusion does.

    Raises:
        SequenceNotFoundError: the folder or one of its parts is missing.
        SequenceError: most listed images lack a pose or depth, or a missing or impossible key.
            Single ones without are left out, and the number is logged.
    """
    if split not in ("train", "test", "all"):
        raise SequenceError(f"split must be train, test or all, got {split!r}")
    root = scene_folder(Path(path))
    require(root, LOOKS_FOR, "scannetpp")
    json_file, suffix = _transforms_file(root, resolution)
    values = read_object(json_file, "nerfstudio transforms")
    names, n_train = _names(root / "train_test_lists.json", split)
    matrices = frame_matrices(values, json_file)
    images = root / f"undistorted_images{suffix}"
    depths = root / f"undistorted_depths{suffix}"
    for folder in (images, depths):
        if not folder.is_dir():
            raise SequenceNotFoundError(
                f"{folder} does not exist; expected the images that {json_file.name} describes"
            )
    list_names = names
    names = [
        n
        for n in list_names
        if n in matrices and is_file(images / n) and is_file(depths / f"{Path(n).stem}.png")
    ]
    n_train = sum(name in names for name in list_names[:n_train])
    _tell_of_lacking(json_file, list_names, names)
    scene = root.resolve()
    if scene.name == "dslr":
        scene = scene.parent
    return RecordedSequence(
        name=scene.name,
        camera=_camera(values, json_file),
        rgb_files=[images / n for n in names],
        depth_files=[depths / f"{Path(n).stem}.png" for n in names],
        timestamps_s=[float(i) for i in range(len(names))],
        poses=torch.stack([matrices[n] for n in names]) @ GL_TO_CV,
        pose_sources=[f"{json_file} frame {n}" for n in names],
        depth_scale=DEPTH_SCALE,
        novel=frozenset(range(n_train, len(names))) if split == "all" else frozenset(),
    )


_MOST_LACKING = 0.5
"""Share of the listed images; releases took out 2 %."""


def _tell_of_lacking(json_file: Path, list_names: list[str], names: list[str]) -> None:
    """Say which listed images are left out: releases take out images, and leave them in the lists.

    Raises:
        SequenceError: most of them.
    """
    lacking = [name for name in list_names if name not in set(names)]
    if len(lacking) > _MOST_LACKING * len(list_names):
        raise SequenceError(
            f"{json_file}: {len(lacking)} of the {len(list_names)} images of train_test_lists.json "
            "have no pose, no image "
            f"or no depth, the first is {lacking[0]}; expected all three for most of them"
        )
    if lacking:
        log.warning(
            "%s: %d of %d listed images are left out, without a pose, an image or its depth, the "
            "first is %s",
            *(json_file, len(lacking), len(list_names), lacking[0]),
        )


def scene_folder(path: Path) -> Path:
    """The ``dslr`` folder of a scene, or ``path`` itself where there is none."""
    return path / "dslr" if (path / "dslr").is_dir() else path


def _transforms_file(root: Path, resolution: str) -> tuple[Path, str]:
    if resolution not in ("auto", *_SUFFIX):
        raise SequenceError(f"resolution must be auto, half or full, got {resolution!r}")
    for suffix in _SUFFIX.values() if resolution == "auto" else (_SUFFIX[resolution],):
        file = root / "nerfstudio" / f"transforms_undistorted{suffix}.json"
        if file.is_file():
            return file, suffix
    raise SequenceNotFoundError(
        f"{file} does not exist; expected the poses and intrinsics of the {resolution} resolution"
    )


def _names(path: Path, split: str) -> tuple[list[str], int]:
    """Images of a split in the published order, and how many of them are for training."""
    lists = read_object(path, "the lists train and test")
    list_kinds = ("train", "test") if split == "all" else (split,)
    for key in list_kinds:
        entries = lists.get(key)
        if not isinstance(entries, list) or not all(isinstance(name, str) for name in entries):
            raise SequenceError(f"{path} must hold the key {key}, a list of image names")
    names = [name for key in list_kinds for name in lists[key]]
    if not names or (split == "all" and not lists["train"]):
        raise SequenceError(f"{path} lists no images for {list_kinds[0]}; expected at least one")
    return names, len(lists["train"]) if "train" in list_kinds else 0


def frame_matrices(
    values: dict[str, Any],
    path: Path,
) -> dict[str, Float[Tensor, "4 4"]]:
    """OpenGL camera-to-world matrix of every image, by file name."""
    matrix_of = {}
    with parsing(path, "frames, each with file_path and a transform_matrix of 4x4 numbers"):
        for entry in [*values["frames"], *values.get("test_frames", [])]:
            matrix = torch.tensor(entry["transform_matrix"], dtype=torch.float64)
            matrix_of[Path(entry["file_path"]).name] = matrix.reshape(4, 4)
    return matrix_of


def _camera(values: dict[str, Any], path: Path) -> Camera:
    model = values.get("camera_model", "PINHOLE")
    coefficients = ("k1", "k2", "k3", "k4", "p1", "p2")
    nonzero = [name for name in coefficients if values.get(name, 0.0) != 0.0]
    if model not in ("PINHOLE", "OPENCV") or nonzero:
        raise SequenceError(
            f"{path} describes a distorted {model} camera; expected the undistorted images' "
            "PINHOLE camera"
        )
    return camera(
        values,
        ("w", "h", "fl_x", "fl_y", "cx", "cy"),
        path,
        shift=0.0,
    )


LAYOUT = Layout(read=scannetpp, looks_for=LOOKS_FOR, locate=scene_folder)
