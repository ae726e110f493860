"""Cases of TSDF integration with colour: frames are fused one after another into an empty volume, without image
decoding."""

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import cv2
import numpy as np

from ...backends import use_backend
from ...config import TsdfConfig
from ...tsdf import TsdfVolume, integrate, raycast
from ...types import Frame
from ...work import PeakMemory
from .cases import DEVICES, BenchCase, BenchOptions, BenchRow, case_name, open_frames, our_backends
from .timing import Lap, lap, summary

VOXEL_SIZES_M = (0.02, 0.01)
TRUNCATION_VOXELS = 4.0
FAR_M = 5.0
LOOK_EVERY = 4
"""Frames from one raycast to the next."""


@runtime_checkable
class Fuser(Protocol):
    """A volume into which frames are fused."""

    device: str

    def prepare(self, frame: Frame) -> Any:
        """Convert the frame to the program's own types; not timed, because a reader could return them directly."""
        ...

    def fuse(self, prepared: Any) -> None:
        """Fuse the frame into the volume; timed."""
        ...


class OurVolume:
    """``gsfusion_nb.tsdf`` on one backend."""

    def __init__(self, backend: str, voxel_size_m: float):
        self.backend, self.device, self.updated_voxels = backend, DEVICES[backend], 0
        config = TsdfConfig(
            voxel_size_m=voxel_size_m, truncation_voxels=TRUNCATION_VOXELS, near_m=0.0, far_m=FAR_M
        )  # fmt: skip
        self.volume = TsdfVolume(config, device=self.device)

    def prepare(self, frame: Frame) -> Any:
        return frame.to(self.device)

    def fuse(self, prepared: Any) -> None:
        with use_backend(self.backend):
            self.updated_voxels += integrate(self.volume, prepared).updated_voxels

    def look_again(self, frames: list[Frame]) -> list[Lap]:
        """Cast the rays of every fourth frame. Returns the time of each; the first call compiles and is left out."""
        camera, poses = frames[0].camera, [frame.T_WC for frame in frames[::LOOK_EVERY]]
        with use_backend(self.backend):
            raycast(self.volume, camera, poses[0])
            return [lap(lambda T_WC=T_WC: raycast(self.volume, camera, T_WC), self.device) for T_WC in poses]


class OpencvHash:
    """OpenCV's hashed volume of 16^3 voxel blocks. It stores no colour, so it does less work than ours."""

    device = "cpu"

    def __init__(self, voxel_size_m: float, first: Frame, threads: int):
        cv: Any = cv2
        cv.setNumThreads(threads)
        setup = cv.VolumeSettings(cv.VolumeType_HashTSDF)
        setup.setVoxelSize(voxel_size_m)
        setup.setTsdfTruncateDistance(TRUNCATION_VOXELS * voxel_size_m)
        setup.setMaxDepth(FAR_M)
        setup.setDepthFactor(1.0)
        setup.setMaxWeight(100)
        setup.setIntegrateWidth(first.camera.width)
        setup.setIntegrateHeight(first.camera.height)
        K = first.camera.K.numpy().astype(np.float32)
        K[:2, 2] -= 0.5  # OpenCV counts pixel centres as whole numbers
        setup.setCameraIntegrateIntrinsics(K)
        self.volume = cv.Volume(cv.VolumeType_HashTSDF, setup)

    def prepare(self, frame: Frame) -> Any:
        return frame.depth_m.numpy(), frame.T_WC.numpy()

    def fuse(self, prepared: Any) -> None:
        self.volume.integrate(*prepared)


def why_no_opencv() -> str:
    """Why OpenCV's volume cannot be timed here; empty if it can."""
    return "" if hasattr(cv2, "VolumeSettings") else "needs version 5: pip install 'opencv-python-headless>=5'"


@dataclass(frozen=True, kw_only=True)
class _Fusion:
    """What is fused, and into which volume."""

    method: str
    voxel_size_m: float
    make: Callable[[Frame], Fuser]


def cases(options: BenchOptions) -> Iterator[BenchCase]:
    """OpenCV first, then our backends, for every image size and voxel size."""
    for size in options.sizes:
        load = functools.lru_cache(1)(functools.partial(stored_frames, options, size))
        for voxel_m in VOXEL_SIZES_M[:1] if options.quick else VOXEL_SIZES_M:
            makers: dict[str, Callable[[Frame], Fuser]] = {}
            if not why_no_opencv():
                makers["OpenCV HashTSDF"] = lambda first, v=voxel_m: OpencvHash(v, first, options.threads)
            for backend in our_backends(options, "band_blocks", "fuse_frame_"):
                makers[backend] = lambda first, b=backend, v=voxel_m: OurVolume(b, v)
            for method, make in makers.items():
                fusion = _Fusion(method=method, voxel_size_m=voxel_m, make=make)
                run = functools.partial(_rows, load, fusion)
                yield BenchCase(section="tsdf", title=f"{options.data} at {100 * voxel_m:g} cm", run=run)


def stored_frames(options: BenchOptions, size: tuple[int, int]) -> tuple[str, list[Frame]]:
    """The name of the case, and the frames of the options, decoded, so that reading is not timed."""
    frames = open_frames(options, size)
    return case_name(frames), [frames[i] for i in range(len(frames))]


def _rows(load: Callable[[], tuple[str, list[Frame]]], fusion: _Fusion) -> list[BenchRow]:
    name, frames = load()
    fuse_all(fusion.make(frames[0]), frames[:1])  # compiles and loads libraries
    device = fusion.make(frames[0]).device
    with PeakMemory(device) as memory:
        fuser = fusion.make(frames[0])
        laps = fuse_all(fuser, frames)
    timing = summary(laps, memory.peak_mb)
    values: dict[str, Any] = {"frames": len(frames), "voxel_size_m": fusion.voxel_size_m}
    values |= {"truncation_voxels": TRUNCATION_VOXELS, "frames_per_second": 1e3 / timing.wall_ms}
    if isinstance(fuser, OurVolume):
        values |= {"blocks": fuser.volume.n_blocks, "updated_voxels_per_frame": fuser.updated_voxels / len(frames)}
    case = f"{name} {100 * fusion.voxel_size_m:g} cm"
    note = f"{values['frames_per_second']:.0f}/s" + (", depth" if isinstance(fuser, OpencvHash) else "")
    rows = [BenchRow(section="tsdf", case=case, method=fusion.method, timing=timing, note=note, values=values)]
    if isinstance(fuser, OurVolume):
        timing = summary(fuser.look_again(frames))
        rows.append(BenchRow(section="tsdf", case=f"{case} / raycast", method=fusion.method, timing=timing))
    return rows


def fuse_all(fuser: Fuser, frames: list[Frame]) -> list[Lap]:
    """Fuse the frames. Returns the time of each."""
    prepared = (fuser.prepare(frame) for frame in frames)
    return [lap(lambda p=p: fuser.fuse(p), fuser.device) for p in prepared]
