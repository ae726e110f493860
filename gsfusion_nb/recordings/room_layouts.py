"""Writing the built-in room to disk in every layout that has a reader, like the original data sets."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..data.lens import CameraModel
from ..data.readers.replica import DEPTH_SCALE as REPLICA_DEPTH_SCALE
from ..data.readers.scannetpp import DEPTH_SCALE as SCANNETPP_DEPTH_SCALE
from ..data.readers.seven_scenes import COLOUR_LENS, DEPTH_CAMERA, T_DEPTH_COLOUR
from ..data.readers.seven_scenes import DEPTH_SCALE as SEVEN_SCENES_DEPTH_SCALE
from ..data.readers.tum import DEPTH_SCALE as TUM_DEPTH_SCALE
from ..data.readers.tum import LENSES
from ..data.recorded.poses import write_pose_lines
from ..data.room.hand_held import write_depth, write_rgb
from ..data.room.sequence import RoomSequence, render_room
from ..geometry import quaternion
from ..types import Camera
from .fetch import SequenceOnDisk

ROOM_DEPTH_SCALE = 10_000.0
"""The room's depth is a multiple of 0.1 mm, so the plain layout stores it without loss."""


@dataclass(frozen=True, kw_only=True)
class Walk:
    """Frames to write: the walk through the room, and the image size where the layout does not prescribe it."""

    n_frames: int = 200
    width: int = 640
    height: int = 480
    seed: int = 0

    @property
    def sequence(self) -> RoomSequence:
        """The room as a sequence."""
        return RoomSequence(n_frames=self.n_frames, width=self.width, height=self.height, seed=self.seed)

    def poses(self) -> Float[Tensor, "N 4 4"]:
        """Camera-to-world, float64. [N, 4, 4]"""
        sequence = self.sequence
        return torch.stack([sequence.pose(i) for i in range(self.n_frames)]).double()

    def render(self, camera: Camera, T_WC: Float[Tensor, "4 4"]) -> tuple[np.ndarray, np.ndarray]:
        """Colour, uint8 RGB, and z-depth in metres for any camera."""
        rgb, depth_m = render_room(camera, T_WC.float(), seed=self.seed)
        return np.rint(rgb.numpy() * 255).astype(np.uint8), depth_m.numpy()


ReportProgress = Callable[[int, int], object]
"""Called with the number of frames done and the total."""

Writer = Callable[[Path, Walk, ReportProgress], SequenceOnDisk]
"""(new folder, frames, progress) -> how to read the result."""


def write_folder(folder: Path, walk: Walk, progress: ReportProgress) -> SequenceOnDisk:
    """The plain layout, lossless: PNG colour, depth in tenths of a millimetre."""
    sequence = walk.sequence
    for i in range(walk.n_frames):
        frame = sequence[i]
        write_rgb(folder / f"rgb/{i:06d}.png", frame.rgb_u8.numpy())
        write_depth(folder / f"depth/{i:06d}.png", frame.depth_m.numpy(), ROOM_DEPTH_SCALE)
        progress(i + 1, walk.n_frames)
    write_pose_lines(folder / "poses.txt", walk.poses())
    write_intrinsics(folder / "intrinsics.json", sequence.camera, depth_scale=ROOM_DEPTH_SCALE)
    return SequenceOnDisk(preset="replica")


def write_intrinsics(path: Path, camera: Camera, *, depth_scale: float) -> None:
    """``intrinsics.json`` of the plain layout, pixel centres at (i + 0.5, j + 0.5) as in the package."""
    values = asdict(camera) | {"depth_scale": depth_scale, "pixel_centre": 0.5, "pose_convention": "camera-to-world"}
    path.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")


def write_replica(folder: Path, walk: Walk, progress: ReportProgress) -> SequenceOnDisk:
    """Like NICE-SLAM's Replica: JPEG colour, 6553.5 per metre, pixel centres at integers."""
    camera, poses = walk.sequence.camera, walk.poses()
    for i, T_WC in enumerate(poses):
        rgb, depth_m = walk.render(camera, T_WC)
        write_rgb(folder / f"results/frame{i:06d}.jpg", rgb)
        write_depth(folder / f"results/depth{i:06d}.png", depth_m, REPLICA_DEPTH_SCALE)
        progress(i + 1, len(poses))
    write_pose_lines(folder / "traj.txt", poses)
    numbers = {"w": camera.width, "h": camera.height, "fx": camera.fx, "fy": camera.fy}
    numbers |= {"cx": camera.cx - 0.5, "cy": camera.cy - 0.5, "scale": REPLICA_DEPTH_SCALE}
    (folder / "cam_params.json").write_text(json.dumps({"camera": numbers}), encoding="utf-8")
    return SequenceOnDisk(preset="replica")


def write_tum(folder: Path, walk: Walk, progress: ReportProgress) -> SequenceOnDisk:
    """Like the TUM benchmark with its third camera (640x480, no distortion), which the folder's name must contain."""
    camera, poses = LENSES["freiburg3"].camera, walk.poses()
    stamps = [f"{1305031102 + 0.001 + i / 30:.6f}" for i in range(len(poses))]
    quats = quaternion.from_matrix(poses[:, :3, :3])[:, [1, 2, 3, 0]]
    rows = torch.cat([poses[:, :3, 3], quats], dim=1).tolist()
    for i, (stamp, T_WC) in enumerate(zip(stamps, poses, strict=True)):
        rgb, depth_m = walk.render(camera, T_WC)
        write_rgb(folder / f"rgb/{stamp}.png", rgb)
        write_depth(folder / f"depth/{stamp}.png", depth_m, TUM_DEPTH_SCALE)
        progress(i + 1, len(poses))
    lists = {kind: [f"{stamp} {kind}/{stamp}.png" for stamp in stamps] for kind in ("rgb", "depth")}
    lists["groundtruth"] = [
        f"{stamp} " + " ".join(f"{value:.9f}" for value in row) for stamp, row in zip(stamps, rows, strict=True)
    ]
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(["# the built-in room", *lines, ""]), encoding="utf-8")
    return SequenceOnDisk(preset="tum")


def write_seven_scenes(folder: Path, walk: Walk, progress: ReportProgress) -> SequenceOnDisk:
    """Like 7-Scenes: colour comes from a second camera beside the depth camera, and is not registered."""
    poses = walk.poses()
    lens = _DistortedView(COLOUR_LENS)
    for i, T_WC in enumerate(poses):
        _, depth_m = walk.render(DEPTH_CAMERA, T_WC)
        wide, _ = walk.render(lens.wide, T_WC @ T_DEPTH_COLOUR)
        stem = f"seq-01/frame-{i:06d}"
        write_rgb(folder / f"{stem}.color.png", lens(wide))
        write_depth(folder / f"{stem}.depth.png", depth_m, SEVEN_SCENES_DEPTH_SCALE)
        lines = ["\t ".join(f"{value: .9e}" for value in row) for row in T_WC.tolist()]
        (folder / f"{stem}.pose.txt").write_text("\n".join([*lines, ""]), encoding="utf-8")
        progress(i + 1, len(poses))
    return SequenceOnDisk(path="seq-01", preset="tum", reader={"register": True})


def write_scannetpp(folder: Path, walk: Walk, progress: ReportProgress) -> SequenceOnDisk:
    """Like ScanNet++ at half resolution; every eighth picture is a published test view."""
    camera, poses = walk.sequence.camera, walk.poses()
    names = [f"DSC{i:05d}.JPG" for i in range(len(poses))]
    frames = {}
    for i, (name, T_WC) in enumerate(zip(names, poses, strict=True)):
        rgb, depth_m = walk.render(camera, T_WC)
        write_rgb(folder / f"dslr/undistorted_images_2/{name}", rgb)
        write_depth(folder / f"dslr/undistorted_depths_2/{Path(name).stem}.png", depth_m, SCANNETPP_DEPTH_SCALE)
        matrix = T_WC @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
        frames[name] = {"file_path": name, "transform_matrix": matrix.tolist(), "is_bad": False}
        progress(i + 1, len(poses))
    lists = {"train": [n for i, n in enumerate(names) if i % 8 != 4], "test": names[4::8]}
    values = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": camera.width}
    values |= {"h": camera.height, "camera_model": "PINHOLE", "frames": [frames[n] for n in lists["train"]]}
    values |= {"test_frames": [frames[n] for n in lists["test"]]}
    (folder / "dslr/nerfstudio").mkdir(parents=True)
    (folder / "dslr/nerfstudio/transforms_undistorted_2.json").write_text(json.dumps(values), encoding="utf-8")
    (folder / "dslr/train_test_lists.json").write_text(json.dumps(lists), encoding="utf-8")
    return SequenceOnDisk(preset="scannetpp")


WRITERS: dict[str, tuple[str, Writer]] = {
    "folder": ("room-folder", write_folder),
    "replica": ("room-replica", write_replica),
    "tum": ("room-tum-freiburg3", write_tum),
    "seven_scenes": ("room-seven-scenes", write_seven_scenes),
    "scannetpp": ("room-scannetpp", write_scannetpp),
}
"""Layout -> name of the folder, and the function that writes it."""


class _DistortedView:
    """Adds lens distortion to a pinhole rendering; the inverse of ``Undistorter``."""

    MARGIN_PX = 24

    def __init__(self, lens: CameraModel):
        import cv2

        c, m = lens.camera, self.MARGIN_PX
        self.wide = Camera(width=c.width + 2 * m, height=c.height + 2 * m, fx=c.fx, fy=c.fy, cx=c.cx + m, cy=c.cy + m)
        K = c.K.numpy().copy()
        K[:2, 2] -= 0.5  # OpenCV puts pixel centres at integers
        u, v = np.meshgrid(np.arange(c.width, dtype=np.float64), np.arange(c.height, dtype=np.float64))
        seen = np.stack([u, v], -1).reshape(-1, 1, 2)
        straight = cv2.undistortPoints(seen, K, np.asarray(lens.distortion), P=K).reshape(c.height, c.width, 2)
        self._u, self._v = (straight[..., k].astype(np.float32) + m for k in (0, 1))

    def __call__(self, wide: np.ndarray) -> np.ndarray:
        import cv2

        return cv2.remap(wide, self._u, self._v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
