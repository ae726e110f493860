"""A box-shaped room with exact depth, to be written to disk in any layout."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.geometry import depth_to_points, se3
from gsfusion_nb.types import Camera, Frame

HALF_SIZE_M = np.array([2.0, 1.5, 2.5])


class Box:
    """The inside of a box, seen by a camera that turns and moves."""

    camera = Camera(
        width=64,
        height=48,
        fx=60.0,
        fy=58.0,
        cx=31.3,
        cy=24.9,
    )

    def poses(self, n: int) -> torch.Tensor:
        """Camera-to-world poses, 2 degrees and 5 cm apart, float64. [n, 4, 4]"""
        return torch.stack([self.pose_at(0.1 * i) for i in range(n)])

    def pose_at(self, t: float) -> torch.Tensor:
        """Screw motion that begins with a look into a corner, where a point moved sideways leaves
        its wall. [4, 4]"""
        corner = se3.exp(torch.tensor([0.1, 0.2, -0.3, 0.4, 0.7, 0.1], dtype=torch.float64))
        return corner @ se3.exp(
            t * torch.tensor([0.3, -0.2, 0.3, 0.2, 0.35, -0.1], dtype=torch.float64)
        )

    def render(
        self, T_WC: torch.Tensor, camera: Camera | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """RGB uint8 [H, W, 3] and z-depth in metres [H, W], by intersecting rays with the walls."""
        camera = camera or self.camera
        u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        ray = np.stack(
            [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)],
            -1,
        )
        T = T_WC.double().numpy()
        d = ray @ T[:3, :3].T
        o = T[:3, 3]
        d = np.where(d == 0, 1e-12, d)
        t = ((np.sign(d) * HALF_SIZE_M - o) / d).min(-1)  # z of the ray is 1, so t is z-depth
        point = o + t[..., None] * d
        rgb = 127.5 + 100 * np.sin(point * np.array([2.0, 3.0, 2.5]))
        return rgb.astype(np.uint8), t

    def write_rgb(self, path: Path, rgb: np.ndarray) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        quality = [cv2.IMWRITE_JPEG_QUALITY, 98] if path.suffix.lower() == ".jpg" else []
        assert cv2.imwrite(str(path), rgb[..., ::-1], quality)

    def write_depth(self, path: Path, depth_m: np.ndarray, scale: float) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), np.rint(depth_m * scale).astype(np.uint16))

    def write_pair(
        self, rgb_file: Path, depth_file: Path, T_WC: torch.Tensor, scale: float, camera=None
    ) -> None:
        rgb, depth_m = self.render(T_WC, camera)
        self.write_rgb(rgb_file, rgb)
        self.write_depth(depth_file, depth_m, scale)

    def off_wall_m(self, frame: Frame) -> float:
        """Mean distance of the frame's points from the walls: 0 only if depth scale, intrinsics and
        pose all fit."""
        points = depth_to_points(frame.camera, frame.depth_m)[frame.depth_m > 0].double()
        gap = torch.from_numpy(HALF_SIZE_M) - se3.apply(frame.T_WC.double(), points).abs()
        return float(gap.abs().min(dim=-1).values.mean())

    def folder(self, root: Path, n: int = 4, **changes) -> Path:
        """The plain layout under ``root``. ``changes`` go into intrinsics.json; None removes a
        key."""
        c = self.camera
        for i, T in enumerate(self.poses(n)):
            self.write_pair(root / f"rgb/{i:06d}.jpg", root / f"depth/{i:06d}.png", T, 1000)
        lines = [" ".join(f"{v:.9f}" for v in T.flatten().tolist()) for T in self.poses(n)]
        (root / "poses.txt").write_text("\n".join([*lines, ""]))
        values = dataclasses.asdict(c) | {"cx": c.cx - 0.5, "cy": c.cy - 0.5, "depth_scale": 1000.0}
        values = {k: v for k, v in (values | changes).items() if v is not None}
        (root / "intrinsics.json").write_text(json.dumps(values))
        return root

    def replica(
        self,
        root: Path,
        n: int = 4,
        numbers: list[int] | None = None,
    ) -> Path:
        """Replica's layout; cam_params.json lies above the scene, as in the archive. Only the
        frames ``numbers``."""
        for i in numbers or range(n):
            files = root / f"results/frame{i:06d}.jpg", root / f"results/depth{i:06d}.png"
            self.write_pair(*files, self.poses(n)[i], 6553.5)
        lines = [" ".join(f"{v:.18e}" for v in T.flatten().tolist()) for T in self.poses(n)]
        (root / "traj.txt").write_text("\n".join(lines))
        values = dataclasses.asdict(self.camera) | {
            "cx": self.camera.cx - 0.5,
            "cy": self.camera.cy - 0.5,
        }
        named = {"w": values.pop("width"), "h": values.pop("height"), **values, "scale": 6553.5}
        (root.parent / "cam_params.json").write_text(json.dumps({"camera": named}))
        return root


@pytest.fixture
def box():
    """The box room."""
    return Box()
