"""A small scene on disk, which other processes can open, and the settings that map it fast."""

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.data.recorded.poses import write_pose_lines
from gsfusion_nb.data.room.write_layouts import write_intrinsics
from gsfusion_nb.lab import RunSpec
from gsfusion_nb.types import Camera

WIDTH, HEIGHT, DEPTH_M, STEP_PX = 48, 36, 1.5, 6

SETTINGS = {
    "data.hold_out_every": 4, "data.hold_out_offset": 2, "tsdf.voxel_size_m": 0.08, "sh_degree": 0,
    "optim.global_iterations": 1, "optim.keyframe_iterations": 2, "optim.frame_iterations": 1,
    "optim.random_keyframe_iterations": 1, "seeding.quadtree_contrast": "std", "seeding.quadtree_threshold": 0.05,
}  # fmt: skip


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """Folder with 7 frames of a painted wall, along which the camera moves: five to map, two held out."""
    folder = tmp_path_factory.mktemp("scene") / "wall"
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    patches = np.random.default_rng(0).integers(20, 236, (5, 14, 3)).astype(np.uint8)
    wall = cv2.resize(patches, (WIDTH + 7 * STEP_PX, HEIGHT), interpolation=cv2.INTER_LINEAR)
    wall[6:20, 20:60:3] //= 2  # stripes, finer than the patches
    for i in range(7):
        cv2.imwrite(str(folder / f"rgb/{i:06d}.png"), wall[:, i * STEP_PX : i * STEP_PX + WIDTH, ::-1])
        cv2.imwrite(str(folder / f"depth/{i:06d}.png"), np.full((HEIGHT, WIDTH), DEPTH_M * 1000, np.uint16))
    poses = torch.eye(4, dtype=torch.float64).repeat(7, 1, 1)
    poses[:, 0, 3] = torch.arange(7) * STEP_PX * DEPTH_M / WIDTH
    write_pose_lines(folder / "poses.txt", poses)
    camera = Camera(width=WIDTH, height=HEIGHT, fx=float(WIDTH), fy=float(WIDTH), cx=WIDTH / 2, cy=HEIGHT / 2)
    write_intrinsics(folder / "intrinsics.json", camera, depth_scale=1000.0)
    return folder


@pytest.fixture
def spec(scene):
    """``spec(rule, **changes)``: a run on the small scene; ``settings`` are added to the fast ones."""

    def make(rule="uniform", settings=None, **changes):
        return RunSpec(rule=rule, scene="wall", data=str(scene), settings=SETTINGS | (settings or {}), **changes)

    return make
