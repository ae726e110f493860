"""Cases of TSDF integration with colour: frames are fused one after another into an empty volume, without image
decoding."""

import functools
from collections.abc import Callable, Iterator
from typing import Any

from ...backends import use_backend
from ...config import TsdfConfig
from ...tsdf import TsdfVolume, integrate, raycast
from ...types import Frame
from ...work import PeakMemory
from .frames import StoredFrames, case_name, stored_frames
from .options import BenchOptions
from .other_programs import OTHER_PROGRAMS, why_not
from .other_tsdf_volumes import Fuser, FusionSettings, Open3dGrid, OpencvHash
from .raster import DEVICES, our_backends
from .rows import Case, Row
from .timing import Lap, lap, summary

VOXEL_SIZES_M = (0.02, 0.01)
TRUNCATION_VOXELS = 4.0
FAR_M = 5.0
LOOK_EVERY = 4
"""Frames from one raycast to the next."""

MAKERS: dict[str, Callable[[FusionSettings, Frame], Fuser]] = {"open3d": Open3dGrid, "opencv": OpencvHash}


class OurVolume:
    """``gsfusion_nb.tsdf`` on one backend."""

    def __init__(self, backend: str, settings: FusionSettings):
        self.backend, self.device = backend, DEVICES[backend]
        config = TsdfConfig(
            voxel_size_m=settings.voxel_size_m,
            truncation_voxels=settings.truncation_voxels,
            near_m=0.0,
            far_m=settings.far_m,
        )
        self.volume = TsdfVolume(config, device=self.device)
        self.updated_voxels = 0

    def prepare(self, frame: Frame) -> Any:
        return frame.to(self.device)

    def fuse(self, prepared: Any) -> None:
        with use_backend(self.backend):
            self.updated_voxels += integrate(self.volume, prepared).updated_voxels

    def look_again(self, frames: StoredFrames) -> list[Lap]:
        """Cast the rays of every fourth frame. Returns the time of each; the first call compiles and is left out."""
        poses = [frames[i].T_WC for i in range(0, len(frames), LOOK_EVERY)]
        with use_backend(self.backend):
            raycast(self.volume, frames.camera, poses[0])
            return [lap(lambda T_WC=T_WC: raycast(self.volume, frames.camera, T_WC), self.device) for T_WC in poses]


def cases(options: BenchOptions) -> Iterator[Case]:
    """Other programs first, then our backends, for every image size and voxel size."""
    for size in options.sizes:
        load = functools.lru_cache(1)(functools.partial(stored_frames, options, size))
        for voxel_m in VOXEL_SIZES_M[:1] if options.quick else VOXEL_SIZES_M:
            settings = FusionSettings(
                voxel_size_m=voxel_m, truncation_voxels=TRUNCATION_VOXELS, far_m=FAR_M, threads=options.threads
            )
            makers: dict[str, Callable[[Frame], Fuser]] = {}
            for name, make in MAKERS.items():
                if why_not(name) is None:
                    makers[OTHER_PROGRAMS[name].name] = functools.partial(make, settings)
            for backend in our_backends(options, "band_blocks", "fuse_frame_"):
                makers[backend] = lambda first, b=backend, s=settings: OurVolume(b, s)
            for method, make in makers.items():
                run = functools.partial(_rows, load, voxel_m, method, make)
                yield Case(section="tsdf", title=f"{options.data} at {100 * voxel_m:g} cm", run=run)


def _rows(load: Callable[[], StoredFrames], voxel_m: float, method: str, make: Callable[[Frame], Fuser]) -> list[Row]:
    frames = load()
    first = make(frames[0])
    fuse_all(first, frames, 1)  # compiles and loads libraries
    device = _device(first)
    del first
    with PeakMemory(device) as memory:
        fuser = make(frames[0])
        laps = fuse_all(fuser, frames, len(frames))
    timing = summary(laps, memory.peak_mb)
    values: dict[str, Any] = {"frames": len(frames), "voxel_size_m": voxel_m, "truncation_voxels": TRUNCATION_VOXELS}
    values["frames_per_second"] = 1e3 / timing.wall_ms
    if isinstance(fuser, OurVolume):
        values |= {"blocks": fuser.volume.n_blocks, "updated_voxels_per_frame": fuser.updated_voxels / len(frames)}
    camera = frames.camera
    case = f"{case_name(frames.name, camera.width, camera.height)} {100 * voxel_m:g} cm"
    note = f"{values['frames_per_second']:.0f}/s" + (", depth" if isinstance(fuser, OpencvHash) else "")
    rows = [Row(section="tsdf", case=case, method=method, timing=timing, note=note, values=values)]
    if isinstance(fuser, OurVolume):
        seen = summary(fuser.look_again(frames))
        rows.append(Row(section="tsdf", case=f"{case} / raycast", method=method, timing=seen))
    return rows


def fuse_all(fuser: Fuser, frames: StoredFrames, n: int) -> list[Lap]:
    """Fuse the first ``n`` frames. Returns the time of each."""
    laps = []
    for i in range(n):
        prepared = fuser.prepare(frames[i])
        laps.append(lap(lambda p=prepared: fuser.fuse(p), _device(fuser)))
    return laps


def _device(fuser: Fuser) -> str:
    """The device of the volume; other programs use the CPU only."""
    return getattr(fuser, "device", "cpu")
