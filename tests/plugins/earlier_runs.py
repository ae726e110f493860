"""A small run in whose map others are located or go on, and how one is stopped on the way."""

import hashlib
from pathlib import Path
from typing import Any

from gsfusion_nb.config import gsfusion
from gsfusion_nb.runs import run_mapping

ROOM: dict[str, Any] = {"n_frames": 120, "width": 160, "height": 120}
SMALL: dict[str, Any] = {
    "tsdf__voxel_size_m": 0.04,
    "tsdf__truncation_voxels": 4.0,
    "sh_degree": 0,
    "data__hold_out_every": 0,
    "optim__global_iterations": 1,
    "seeding__quadtree_threshold": 0.05,
}


def map_first_frames(folder: Path) -> Path:
    """Map the first ten frames of the walk into ``folder``, which it returns."""
    config = gsfusion("replica", **SMALL, data__stop=10)
    run_mapping("room", config, folder=folder, evaluate=False, **ROOM)
    return folder


def hashes(folder: Path) -> dict[str, str]:
    """File -> SHA-256."""
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.iterdir()}


class StopAfter:
    """Ends a run after some frames, as an error does."""

    def __init__(self, n: int):
        self.n = n

    def frame_mapped(self, mapper, frame, report):
        self.n -= 1
        if not self.n:
            raise RuntimeError("stopped")

    def finished(self, mapper, mesh, metrics):
        pass
