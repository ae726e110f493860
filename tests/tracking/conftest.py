"""Scenes of infinite planes, whose depth and normals are known exactly from any pose."""

import pytest
import torch

from gsfusion_nb.geometry import pixel_grid, rays, se3
from gsfusion_nb.tracking import Surface
from gsfusion_nb.types import Camera, Frame

CAMERA = Camera(
    width=160,
    height=120,
    fx=110.0,
    fy=110.0,
    cx=80.0,
    cy=60.0,
)

PLANES = {
    "wall": [((0.0, 0.0, -1.0), 2.0)],
    "edge": [((0.6, 0.0, -0.8), 2.0), ((-0.6, 0.0, -0.8), 2.0)],
    "corridor": [
        ((1.0, 0.0, 0.0), 1.0),
        ((-1.0, 0.0, 0.0), 1.0),
        ((0.0, -1.0, 0.0), 1.2),
        ((0.0, 1.0, 0.0), 1.2),
    ],
    "corner": [((0.6, 0.0, -0.8), 2.0), ((-0.6, 0.0, -0.8), 2.0), ((0.0, -0.8, -0.6), 1.2)],
}
"""Unit normals towards the camera n and distances d: points with n . x + d = 0."""

FAR_M = 6.0


class PlaneScene:
    """Renders planes as ``Surface`` (a ``SurfaceSource``), and frames of them."""

    def __init__(self, name: str, painted: bool = False):
        self.planes = PLANES[name]
        self.painted = painted
        self.rendered: list[torch.Tensor] = []

    def __call__(self, camera: Camera, T_WC: torch.Tensor) -> Surface:
        self.rendered.append(T_WC)
        direction = se3.rotate(T_WC.double(), rays(camera, pixel_grid(camera, dtype=torch.float64)))
        depth = torch.full(direction.shape[:2], torch.inf, dtype=torch.float64)
        normal = torch.zeros_like(direction)
        for n, d in self.planes:
            n = torch.tensor(n, dtype=torch.float64)
            z = -(n @ T_WC[:3, 3].double() + d) / (direction @ n)
            nearer = (z > 0) & (z < depth)
            depth = z.where(nearer, depth)
            normal = n.where(nearer[..., None], normal)
        depth = depth.where(depth < FAR_M, 0.0)
        normal = normal.where(depth[..., None] > 0, 0.0)
        xyz_W = T_WC[:3, 3].double() + depth[..., None] * direction
        rgb = self.paint(xyz_W).float() if self.painted else None
        return Surface(
            depth_m=depth.float(),
            normal_W=normal.float(),
            camera=camera,
            T_WC=T_WC,
            rgb=rgb,
        )

    @staticmethod
    def paint(xyz_W: torch.Tensor) -> torch.Tensor:
        """Colours of the points: waves of 30 to 60 cm."""
        waves = torch.tensor(
            [[11.0, 3.0, -7.0], [-5.0, 13.0, 9.0], [17.0, -9.0, 4.0]],
            dtype=torch.float64,
        )
        return 0.4 + 0.3 * torch.sin(xyz_W @ waves.T)

    def frame(
        self,
        T_WC: torch.Tensor,
        index: int = 0,
        timestamp_s: float | None = None,
    ) -> Frame:
        """What a camera measures."""
        seen = PlaneScene.__call__(self, CAMERA, T_WC)
        rgb = torch.zeros(*seen.depth_m.shape, 3) if seen.rgb is None else seen.rgb
        depth_m = seen.depth_m
        time = float(index) if timestamp_s is None else timestamp_s
        return Frame(
            index=index,
            timestamp_s=time,
            rgb=rgb,
            depth_m=depth_m,
            camera=CAMERA,
            T_WC=T_WC.to(torch.float32),
        )


@pytest.fixture
def plane_scene():
    """``plane_scene("wall" | "edge" | "corner" | "corridor", painted=False)``."""
    return PlaneScene


@pytest.fixture
def assert_pose():
    """``assert_pose(T, expected, metres, degrees)``."""

    def check(
        T: torch.Tensor,
        expected: torch.Tensor,
        metres: float,
        degrees: float,
    ) -> None:
        miss = se3.inverse(expected.double()) @ T.double()
        off_m = float(miss[:3, 3].norm())
        off_deg = float(se3.rotation_angle(miss[:3, :3]).rad2deg())
        assert off_m < metres, f"{off_m * 1e3:.3f} mm off"
        assert off_deg < degrees, f"{off_deg:.4f} degrees off"

    return check
