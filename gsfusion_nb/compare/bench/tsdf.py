"""Cases of TSDF integration with colour: frames are fused one after another into an empty volume, without image
decoding."""

import functools
from collections.abc import Callable, Iterator

from ...backends import use_backend
from ...config import TsdfConfig
from ...tsdf import TsdfVolume, integrate, raycast
from ...types import Frame
from ...work import PeakMemory
from .cases import DEVICES, BenchCase, BenchOptions, BenchRow, case_name, open_frames, our_backends
from .timing import lap, summary

VOXEL_SIZES_M = (0.02, 0.01)
TRUNCATION_VOXELS = 4.0
FAR_M = 5.0
LOOK_EVERY = 4
"""Frames from one raycast to the next."""


def cases(options: BenchOptions) -> Iterator[BenchCase]:
    """Our backends, for every image size and voxel size."""
    for size in options.sizes:
        load = functools.lru_cache(1)(functools.partial(_stored_frames, options, size))
        for voxel_m in VOXEL_SIZES_M[:1] if options.quick else VOXEL_SIZES_M:
            for backend in our_backends(options, "band_blocks", "fuse_frame_"):
                run = functools.partial(_rows, load, backend, voxel_m)
                yield BenchCase(section="tsdf", title=f"{options.data} at {100 * voxel_m:g} cm", run=run)


def _stored_frames(options: BenchOptions, size: tuple[int, int]) -> tuple[str, list[Frame]]:
    """The name of the case, and the frames of the options, decoded, so that reading is not timed."""
    frames = open_frames(options, size)
    return case_name(frames), [frames[i] for i in range(len(frames))]


def _rows(load: Callable[[], tuple[str, list[Frame]]], backend: str, voxel_m: float) -> list[BenchRow]:
    """The time per frame, and that of casting the rays of every fourth frame."""
    device, (name, frames) = DEVICES[backend], load()
    frames = [frame.to(device) for frame in frames]
    camera, poses = frames[0].camera, [frame.T_WC for frame in frames[::LOOK_EVERY]]
    config = TsdfConfig(voxel_size_m=voxel_m, truncation_voxels=TRUNCATION_VOXELS, near_m=0.0, far_m=FAR_M)
    with use_backend(backend):
        volume = TsdfVolume(config, device=device)
        integrate(volume, frames[0])  # compiles, as does the first raycast
        raycast(volume, camera, poses[0])
        with PeakMemory(device) as memory:
            volume, updated = TsdfVolume(config, device=device), []
            laps = [
                lap(lambda frame=frame: updated.append(integrate(volume, frame).updated_voxels), device)
                for frame in frames
            ]
        looks = [lap(lambda T_WC=T_WC: raycast(volume, camera, T_WC), device) for T_WC in poses]
    timing, case = summary(laps, memory.peak_mb), f"{name} {100 * voxel_m:g} cm"
    values = {
        "frames": len(frames),
        "voxel_size_m": voxel_m,
        "truncation_voxels": TRUNCATION_VOXELS,
        "frames_per_second": 1e3 / timing.wall_ms,
        "blocks": volume.n_blocks,
        "updated_voxels_per_frame": sum(updated) / len(frames),
    }
    note = f"{values['frames_per_second']:.0f}/s"
    return [
        BenchRow(section="tsdf", case=case, method=backend, timing=timing, note=note, values=values),
        BenchRow(section="tsdf", case=f"{case} / raycast", method=backend, timing=summary(looks)),
    ]
