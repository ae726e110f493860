"""Contexts of a real map, for trying and checking seeding rules: the built-in room, mapped by GSFusion, very small."""

import copy
import dataclasses
import functools
from typing import Any

import torch

from ..config import gsfusion
from ..data.room import room
from ..mapping import GSFusion
from ..seeding import SeedContext
from ..tsdf import integrate
from ..types import Frame

N_MAPPED = 4
"""Frames that are mapped before the one of the context."""


def mapped_contexts() -> dict[str, SeedContext]:
    """What a rule sees of a frame of the built-in room, 48 x 36 pixels, after GSFusion mapped four others.

    The map is made once in a process; each call returns copies. "seen": the frame is close to
    the last one; "turned": it looks where the map is empty for the most part. ::

        check_rule(my_rule, mapped_contexts())
    """
    state, frames = _small_map()
    return {name: _context(state, frame) for name, frame in frames.items()}


@functools.cache
def _small_map() -> tuple[dict[str, Any], dict[str, Frame]]:
    config = gsfusion(
        "room",
        tsdf={"voxel_size_m": 0.08, "truncation_voxels": 4.0},
        seeding={"quadtree_contrast": "std", "quadtree_threshold": 0.03},
        sh_degree=1,
        keyframe_every=2,
    )
    scene = room(n_frames=120, width=48, height=36)
    mapper = GSFusion(config)
    for number in range(N_MAPPED):
        mapper.step(scene[2 * number])
    return mapper.state_dict(), {"seen": scene[2 * N_MAPPED], "turned": scene[60]}


def _context(state: dict[str, Any], frame: Frame) -> SeedContext:
    """The context of the frame in a new mapper with this state, with the frame in the volume."""
    mapper = GSFusion.from_state_dict(copy.deepcopy(state))
    integrate(mapper.volume, frame)
    return dataclasses.replace(mapper.seed_context(frame), generator=torch.Generator().manual_seed(0))
