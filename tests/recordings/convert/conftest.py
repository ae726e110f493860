"""A few frames of the built-in room, to be written in the real format of other programs and read
back."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.data import folder
from gsfusion_nb.data.room import room
from gsfusion_nb.geometry import quaternion
from gsfusion_nb.types import Camera

WIDTH = 60
HEIGHT = 44
"""Cut from 64x48, so that the principal point is not in the middle and a swap of anything shows."""


@dataclass(frozen=True)
class Takes:
    """Pictures, poses and times of four frames."""

    camera: Camera
    rgb: list[np.ndarray]
    depth_m: list[np.ndarray]
    T_WC: torch.Tensor
    """float64. [N, 4, 4]"""
    times_s: list[float]

    def __len__(self) -> int:
        return len(self.rgb)

    def png(self, i: int) -> bytes:
        return cv2.imencode(".png", self.rgb[i][..., ::-1])[1].tobytes()

    def jpeg(self, i: int) -> bytes:
        return cv2.imencode(
            ".jpg",
            self.rgb[i][..., ::-1],
            [cv2.IMWRITE_JPEG_QUALITY, 97],
        )[1].tobytes()

    def depth_raw(self, i: int, scale: float = 1000.0) -> np.ndarray:
        return np.rint(self.depth_m[i] * scale).astype(np.uint16)

    def depth_png(self, i: int, scale: float = 1000.0) -> bytes:
        return cv2.imencode(".png", self.depth_raw(i, scale))[1].tobytes()

    def tum_row(self, i: int) -> list[float]:
        """tx ty tz qx qy qz qw"""
        quat = quaternion.from_matrix(self.T_WC[i, :3, :3])
        return [*self.T_WC[i, :3, 3].tolist(), *quat[[1, 2, 3, 0]].tolist()]

    def write(self, path: Path, data: bytes) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        return path

    def check(
        self,
        out: Path,
        frames=None,
        *,
        depth_m=5.1e-4,
        rgb=0,
        pose=1e-6,
        camera=None,
    ) -> None:
        """The folder holds these frames: same pixels, depth within ``depth_m`` metres, camera and
        poses equal."""
        sequence = folder(out)
        frames = range(len(self)) if frames is None else frames
        wanted = camera or self.camera
        assert vars(sequence.camera) == pytest.approx(vars(wanted), abs=1e-4)
        assert len(sequence) == len(frames)
        for frame, i in zip(sequence, frames, strict=True):
            assert np.abs(frame.rgb_u8.numpy().astype(int) - self.rgb[i]).mean() <= rgb
            assert np.abs(frame.depth_m.numpy() - self.depth_m[i]).max() <= depth_m
            assert torch.allclose(frame.T_WC.double(), self.T_WC[i], atol=pose)


@pytest.fixture(scope="session")
def takes() -> Takes:
    """Four frames of the built-in room, 0.2 s apart."""
    source = room(n_frames=240, width=64, height=48)
    frames = [source[i] for i in range(4)]
    c = source.camera
    return Takes(
        camera=Camera(width=WIDTH, height=HEIGHT, fx=c.fx, fy=c.fy, cx=c.cx, cy=c.cy),
        rgb=[np.ascontiguousarray(f.rgb_u8.numpy()[:HEIGHT, :WIDTH]) for f in frames],
        depth_m=[f.depth_m.numpy()[:HEIGHT, :WIDTH] for f in frames],
        T_WC=torch.stack([_rigid(f.T_WC) for f in frames]),
        times_s=[1700000000.0 + 0.2 * i for i in range(4)],
    )


def _rigid(T_WC: torch.Tensor) -> torch.Tensor:
    """The float32 pose with a rotation that is exact in float64."""
    T = T_WC.double().clone()
    T[:3, :3] = quaternion.to_matrix(quaternion.from_matrix(T[:3, :3]))
    return T
