"""Frames fused into an empty volume, and raycasts of it."""

from collections.abc import Iterator, Sequence
from functools import partial

from ...backends import use_backend
from ...config import TsdfConfig
from ...resources import PeakMemory
from ...tsdf import TsdfVolume, integrate, raycast
from ...types import Frame
from .options import DEVICES, BenchOptions, BenchRow, case_name, open_frames, our_backends
from .timing import lap, summary

VOXEL_SIZES_M = (0.02, 0.01)
TRUNCATION_VOXELS = 4.0
FAR_M = 5.0
LOOK_EVERY = 4
"""Frames from one raycast to the next."""


def tsdf_rows(options: BenchOptions) -> Iterator[BenchRow]:
    """Integration with colour: decoded frames are fused one after another into an empty volume;
    then raycasts."""
    for size in options.sizes:
        sequence = open_frames(options, size)
        frames = [sequence[i] for i in range(len(sequence))]
        for voxel_m in VOXEL_SIZES_M[:1] if options.quick else VOXEL_SIZES_M:
            case = f"{case_name(sequence)} {100 * voxel_m:g} cm"
            for backend in our_backends(options, "band_blocks", "fuse_frame_"):
                yield from _volume_rows(frames, voxel_m, backend, case)


def _volume_rows(
    frames: Sequence[Frame], voxel_m: float, backend: str, case: str
) -> Iterator[BenchRow]:
    """One volume on one backend: a row of its integration, and one of its raycasts."""
    config = TsdfConfig(
        voxel_size_m=voxel_m, truncation_voxels=TRUNCATION_VOXELS, near_m=0.0, far_m=FAR_M
    )
    device = DEVICES[backend]
    frames = [frame.to(device) for frame in frames]
    camera = frames[0].camera
    poses = [frame.T_WC for frame in frames[::LOOK_EVERY]]
    n_updated: list[int] = []

    def fuse(frame: Frame) -> None:
        n_updated.append(integrate(volume, frame).updated_voxels)

    with use_backend(backend):
        warm_up_volume = TsdfVolume(config, device=device)
        integrate(warm_up_volume, frames[0])  # compiles, as does the first raycast
        raycast(warm_up_volume, camera, poses[0])
        with PeakMemory(device) as memory:
            volume = TsdfVolume(config, device=device)
            fusion_laps = [lap(partial(fuse, frame), device) for frame in frames]
        raycast_laps = [lap(lambda T=T_WC: raycast(volume, camera, T), device) for T_WC in poses]
    yield BenchRow(
        section="tsdf",
        case=case,
        method=backend,
        timing=summary(fusion_laps, memory.peak_mb),
        values={
            "frames": len(frames),
            "blocks": volume.n_blocks,
            "updated_voxels_per_frame": sum(n_updated) / len(frames),
        },
    )
    yield BenchRow(
        section="tsdf", case=f"{case} / raycast", method=backend, timing=summary(raycast_laps)
    )
