"""How much memory a map will need, before it is made."""

import dataclasses

from ..config import SystemConfig, TsdfConfig, replace
from ..data import OpenedSequence, SequenceError, SequenceView
from ..mapping import make_mapper
from ..tsdf import TsdfVolume
from ..tsdf.allocate import new_band_blocks
from .mapping_run import evenly, has_poses
from .scored_views import readable_frames

VIEWS, TRIAL = 200, 8
"""Frames of which the blocks are counted, and frames that are mapped, both evenly spread."""
PROCESS_GB = 0.5
"""Of a process without a map."""


def estimate_memory(sequence: OpenedSequence, config: SystemConfig) -> dict[str, float]:
    """The memory that the map of a recording will need, GB, by what takes it.

    The voxel blocks that some frames see are counted, without their voxels. A few frames are mapped, and the whole map
    is taken to have as many Gaussians a block as that map. Every frame counts as a keyframe, so that pictures are an
    upper bound. The mesh at the end is not counted.

    Args:
        sequence: The recording.
        config: Settings of the run.

    Raises:
        SequenceError: the recording has no poses.
    """
    frames, n = sequence.mapping, len(sequence.mapping)
    if not has_poses(frames):
        raise SequenceError(f"{sequence.name} has no poses, so what its frames see together is not known beforehand")
    mapper = make_mapper(replace(config, tracking__poses="given"))
    has_volume, settings = hasattr(config, "tsdf"), getattr(config, "tsdf", TsdfConfig(voxel_size_m=0.04))
    whole, part = TsdfVolume(settings), TsdfVolume(settings)

    def view(limit: int) -> SequenceView:
        return dataclasses.replace(frames, positions=[frames.positions[i] for i in evenly(n, limit)])

    for frame in readable_frames(view(VIEWS)):
        whole.index.add(new_band_blocks(whole, frame))
    for frame in readable_frames(view(TRIAL)):
        part.index.add(new_band_blocks(part, frame))
        mapper.step(frame)
    columns, share = mapper.gaussians.columns.values(), whole.n_blocks / max(1, part.n_blocks)
    pixels = sequence.camera.width * sequence.camera.height
    return {
        "voxel blocks": whole.memory_bytes / 1e9 if has_volume else 0.0,
        "Gaussians": share * sum(column.nbytes for column in columns) / 1e9,
        "pictures, at most": n * pixels * (3 + 4) / 1e9,
        "process": PROCESS_GB,
    }
