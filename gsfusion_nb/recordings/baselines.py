"""A recording in the layouts that other trainers of Gaussians and radiance fields read, with the
frames, the size and the held-out views of a run here, so that a baseline sees the same.

    nerfstudio    transforms.json, images/, depths/, sparse_pc.ply
    colmap        sparse/0/ (cameras.txt, images.txt, points3D.txt, test.txt), images/, depths/

Both have the pixels that a run maps: undistorted, of its size, as PNG. Depth is 16-bit PNG in
millimetres. Points for a trainer's first Gaussians come from the depth. COLMAP's poses are
world-to-camera, nerfstudio's camera-to-world with y up and z backward (OpenGL).
"""

import json
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from ..checks import check_name
from ..data import OpenedSequence
from ..data.recorded.poses import GL_TO_CV
from ..drawing.encoding import encode_png
from ..errors import BadFrameError, SequenceError
from ..files import atomic_folder
from ..geometry import backproject, quaternion, se3
from ..types import Camera, Frame

log = logging.getLogger(__name__)

MOST_POINTS = 100_000
"""Points for the first Gaussians of a trainer; 3D Gaussian splatting starts Replica with as
many."""

DEPTH_PER_M = 1000
MOST_DEPTH_M = 65.535


@dataclass(frozen=True, kw_only=True)
class _View:
    """A frame whose images are written."""

    name: str
    """Of its image, without a folder."""
    index: int
    T_WC: Tensor
    held_out: bool


@dataclass(frozen=True, kw_only=True)
class _Points:
    """Coloured points of the scene."""

    xyz_W: np.ndarray
    """float64 [N, 3]"""
    rgb: np.ndarray
    """uint8 [N, 3]"""


def write_for_baseline(sequence: OpenedSequence, out: Path, layout: str) -> int:
    """Write the frames of a sequence to a new folder, those to map and those held out.

    Frames that cannot be read are left out; a warning of the log counts them.

    Args:
        sequence: The frames, with poses.
        out: New or empty folder.
        layout: A name in ``LAYOUTS``.

    Returns:
        The number of frames.

    Raises:
        SequenceError: the recording has no poses, or no frame can be read.
        FileExistsError: ``out`` is in use. KeyError: no such layout.
    """
    check_name("layout", layout, LAYOUTS)
    if not getattr(sequence.source, "has_poses", True):
        raise SequenceError(
            f"{sequence.name} has no poses, which a baseline needs; map it with tracking, and give "
            "the run's trajectory as its poses"
        )
    with atomic_folder(out, out.with_name(f".{out.name}.partial")) as folder:
        (folder / "images").mkdir()
        (folder / "depths").mkdir()
        views = []
        points = []
        n_frames = len(sequence.mapping) + len(sequence.held_out)
        for frame, held_out in _frames(sequence):
            view = _View(
                name=f"{frame.index:06d}.png",
                index=frame.index,
                T_WC=frame.T_WC_cpu.double(),
                held_out=held_out,
            )
            views.append(view)
            _write_images(folder, view.name, frame)
            if not held_out:
                points.append(_points_of(frame, -(-MOST_POINTS // len(sequence.mapping))))
        if not points:
            raise SequenceError(f"no frame of {sequence.name} can be read")
        if len(views) < n_frames:
            log.warning("%d frames cannot be read and are left out", n_frames - len(views))
        all_points = _Points(
            xyz_W=np.concatenate([p.xyz_W for p in points]),
            rgb=np.concatenate([p.rgb for p in points]),
        )
        LAYOUTS[layout](folder, sequence.camera, views, all_points)
    return len(views)


def _frames(sequence: OpenedSequence) -> Iterator[tuple[Frame, bool]]:
    """The frames that can be read, and whether each is held out, in the order of the recording."""
    places = [(p, i, False) for i, p in enumerate(sequence.mapping.positions)]
    places += [(p, i, True) for i, p in enumerate(sequence.held_out.positions)]
    for _, i, held_out in sorted(places):
        part = sequence.held_out if held_out else sequence.mapping
        try:
            yield part[i], held_out
        except BadFrameError as e:
            log.info("%s", e)


def _write_images(folder: Path, name: str, frame: Frame) -> None:
    (folder / "images" / name).write_bytes(encode_png(frame.rgb_u8.cpu().numpy()))
    depth_m = frame.depth_m.cpu().double().numpy()
    stored = np.where(depth_m <= MOST_DEPTH_M, np.rint(depth_m * DEPTH_PER_M), 0)
    png = cv2.imencode(".png", stored.astype(np.uint16))[1]
    (folder / "depths" / name).write_bytes(png.tobytes())


def _points_of(frame: Frame, n: int) -> _Points:
    """Up to ``n`` points of a frame, the same ones each time."""
    generator = torch.Generator().manual_seed(frame.index)
    frame = frame.to("cpu")
    v, u = (frame.depth_m > 0).nonzero().unbind(1)
    picks = torch.randperm(len(u), generator=generator)[:n]
    uv = torch.stack([u[picks], v[picks]], dim=1) + 0.5
    xyz_C = backproject(frame.camera, uv, frame.depth_m[v[picks], u[picks]])
    return _Points(
        xyz_W=se3.apply(frame.T_WC.double(), xyz_C.double()).numpy(),
        rgb=frame.rgb_u8[v[picks], u[picks]].numpy(),
    )


def _write_nerfstudio(folder: Path, camera: Camera, views: list[_View], points: _Points) -> None:
    to_gl = torch.as_tensor(GL_TO_CV, dtype=torch.float64)  # its own inverse
    frames = [
        {
            "file_path": f"images/{view.name}",
            "depth_file_path": f"depths/{view.name}",
            "transform_matrix": (view.T_WC @ to_gl).tolist(),
        }
        for view in views
    ]
    held_out = [f"images/{view.name}" for view in views if view.held_out]
    document = {
        "camera_model": "PINHOLE",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "depth_unit_scale_factor": 1 / DEPTH_PER_M,
        "ply_file_path": "sparse_pc.ply",
        "frames": frames,
        "train_filenames": [f"images/{view.name}" for view in views if not view.held_out],
        "val_filenames": held_out,
        "test_filenames": held_out,
    }
    (folder / "transforms.json").write_text(json.dumps(document, indent=1), encoding="utf-8")
    columns = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1")]
    vertices = np.empty(len(points.xyz_W), dtype=[*columns, ("blue", "u1")])
    for i, axis in enumerate("xyz"):
        vertices[axis] = points.xyz_W[:, i]
    for i, channel in enumerate(("red", "green", "blue")):
        vertices[channel] = points.rgb[:, i]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
        "end_header\n",
    ]
    content = "\n".join(header).encode("ascii") + vertices.tobytes()
    (folder / "sparse_pc.ply").write_bytes(content)


def _write_colmap(folder: Path, camera: Camera, views: list[_View], points: _Points) -> None:
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    (model / "cameras.txt").write_text(f"1 PINHOLE {' '.join(map(repr, numbers))}\n")
    lines = []
    for number, view in enumerate(views, 1):
        T_CW = se3.inverse(view.T_WC)
        pose = [*quaternion.from_matrix(T_CW[:3, :3]).tolist(), *T_CW[:3, 3].tolist()]
        lines.append(f"{number} {' '.join(map(repr, pose))} 1 {view.name}\n\n")
    (model / "images.txt").write_text("".join(lines))
    rows = (
        f"{number} {x:.6f} {y:.6f} {z:.6f} {r} {g} {b} 0\n"
        for number, ((x, y, z), (r, g, b)) in enumerate(
            zip(points.xyz_W.tolist(), points.rgb.tolist(), strict=True), 1
        )
    )
    (model / "points3D.txt").write_text("".join(rows))
    held_out = [view.name for view in views if view.held_out]
    (model / "test.txt").write_text("".join(f"{name}\n" for name in held_out))


LAYOUTS: dict[str, Callable[[Path, Camera, list[_View], _Points], None]] = {
    "nerfstudio": _write_nerfstudio,
    "colmap": _write_colmap,
}
"""Name of a layout -> what writes all but the images."""
