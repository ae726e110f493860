"""Depth images of a sphere in front of a wall, with holes and outliers; the CUDA kernels compiled for the processor."""

import importlib.util
import platform
import shutil
from pathlib import Path

import pytest
import torch

from gsfusion_nb.geometry import pixel_grid, rays
from gsfusion_nb.types import Camera, Frame


@pytest.fixture(scope="session")
def emulator():
    """The module that compiles the CUDA kernels for the processor."""
    spec = importlib.util.spec_from_file_location("emulator", Path(__file__).parent / "cuda" / "emulator.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def emulator_library(emulator, tmp_path_factory) -> Path:
    """The compiled library, which ``GSFUSION_CUDA_EMULATOR`` names."""
    if platform.system() != "Linux" or not shutil.which("g++"):
        pytest.skip("the CPU emulator of the CUDA kernels needs Linux and g++")
    return emulator.build(tmp_path_factory.mktemp("emulator"))


def look_from(position) -> torch.Tensor:
    """A camera that looks at the origin."""
    position = torch.tensor(position, dtype=torch.float64)
    z = torch.nn.functional.normalize(-position, dim=0)
    x = torch.nn.functional.normalize(torch.linalg.cross(z, torch.tensor([0.1, -1.0, 0.2]).double()), dim=0)
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.stack([x, torch.linalg.cross(z, x), z], dim=1)
    T[:3, 3] = position
    return T.float()


@pytest.fixture
def make_frames(generator):
    """``make_frames(width, height, n, shift, eight_bit)``: views of a sphere of 0.5 m and a wall 0.9 m behind it."""

    def make(width: int, height: int, n: int = 3, shift: float = 0.0, eight_bit: bool = True) -> list[Frame]:
        camera = Camera(width=width, height=height, fx=0.9 * width, fy=0.95 * width, cx=0.52 * width, cy=0.48 * height)
        frames = []
        for i in range(n):
            T_WC = look_from((1.3 - 0.3 * i, 0.2 + 0.5 * i, 0.1 - 0.4 * i))
            centre = T_WC[:3, :3].double().T @ -T_WC[:3, 3].double()
            d = rays(camera, pixel_grid(camera, dtype=torch.float64))
            a, b, e = (d * d).sum(-1), d @ centre, centre @ centre - 0.25
            root = b * b - a * e
            depth = torch.where(root > 0, (b - root.clamp_min(0).sqrt()) / a, float(centre[2]) + 0.9).float()
            rough = torch.rand(depth.shape, generator=generator)
            depth = torch.where(rough < 0.1, 0.0, depth + 0.002 * rough)
            depth[rough > 0.995] = 0.7
            rgb = torch.rand(height, width, 3, generator=generator)
            rgb = (rgb * 255).round() / 255 if eight_bit else rgb
            T_WC[:3, 3] += shift
            frames.append(Frame(index=i, timestamp_s=float(i), rgb=rgb, depth_m=depth, camera=camera, T_WC=T_WC))
        return frames

    return make
