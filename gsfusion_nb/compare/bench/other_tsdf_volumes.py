"""TSDF volumes of other programs, with the two methods that the TSDF bench calls."""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ...types import Frame

DEPTH_SCALE = 1000.0
"""Stored value of one metre, for programs with 16-bit depth."""


@dataclass(frozen=True, kw_only=True)
class FusionSettings:
    """Settings that are the same for every method."""

    voxel_size_m: float
    truncation_voxels: float
    far_m: float
    threads: int


@runtime_checkable
class Fuser(Protocol):
    """A volume into which frames are fused."""

    def prepare(self, frame: Frame) -> Any:
        """Convert the frame to the program's own types; not timed, because a reader could return them directly."""
        ...

    def fuse(self, prepared: Any) -> None:
        """Fuse the frame into the volume; timed."""
        ...


class Open3dGrid:
    """Open3D's VoxelBlockGrid with colour: voxel blocks of 16^3, weight and colour in 16 bits (its fastest setting).

    It truncates (u, v) to find a depth pixel, which is right for intrinsics that count from pixel edges, as here. Its
    legacy volume is not compared, because its meshes are empty since version 0.20.
    """

    def __init__(self, settings: FusionSettings, first: Frame):
        import open3d as o3d  # pyright: ignore[reportMissingImports]

        if hasattr(o3d.utility, "set_max_threads"):  # since 0.20; before, OMP_NUM_THREADS decides
            o3d.utility.set_max_threads(settings.threads)
        self.o3d, self.core = o3d, o3d.core
        self.settings = settings
        kinds = (self.core.float32, self.core.uint16, self.core.uint16)
        blocks = 6000
        self.grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"), kinds, ((1), (1), (3)), settings.voxel_size_m, 16, blocks,
            self.core.Device("CPU:0"),
        )  # fmt: skip
        self.K = self.core.Tensor(first.camera.K.numpy())

    def prepare(self, frame: Frame) -> Any:
        depth = np.rint(frame.depth_m.numpy() * DEPTH_SCALE).astype(np.uint16)
        rgb = frame.rgb_u8.numpy()
        return depth, rgb, np.linalg.inv(frame.T_WC.double().numpy())

    def fuse(self, prepared: Any) -> None:
        depth, rgb = (self.o3d.t.geometry.Image(self.core.Tensor(image)) for image in prepared[:2])
        T_CW = self.core.Tensor(prepared[2])
        s = self.settings
        limits = (DEPTH_SCALE, s.far_m, s.truncation_voxels)
        blocks = self.grid.compute_unique_block_coordinates(depth, self.K, T_CW, *limits)
        self.grid.integrate(blocks, depth, rgb, self.K, self.K, T_CW, *limits)


class OpencvHash:
    """OpenCV's hashed volume of 16^3 voxel blocks. It stores no colour, so it does less work than the others."""

    def __init__(self, settings: FusionSettings, first: Frame):
        import cv2

        cv: Any = cv2
        cv.setNumThreads(settings.threads)
        camera = first.camera
        setup = cv.VolumeSettings(cv.VolumeType_HashTSDF)
        setup.setVoxelSize(settings.voxel_size_m)
        setup.setTsdfTruncateDistance(settings.truncation_voxels * settings.voxel_size_m)
        setup.setMaxDepth(settings.far_m)
        setup.setDepthFactor(1.0)
        setup.setMaxWeight(100)
        setup.setIntegrateWidth(camera.width)
        setup.setIntegrateHeight(camera.height)
        K = camera.K.numpy().astype(np.float32)
        K[:2, 2] -= 0.5  # OpenCV counts pixel centres as whole numbers
        setup.setCameraIntegrateIntrinsics(K)
        self.volume = cv.Volume(cv.VolumeType_HashTSDF, setup)

    def prepare(self, frame: Frame) -> Any:
        return frame.depth_m.numpy(), frame.T_WC.numpy()

    def fuse(self, prepared: Any) -> None:
        self.volume.integrate(*prepared)
