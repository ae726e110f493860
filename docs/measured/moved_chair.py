"""What is left of a chair that moved, and what is found of it at its new place:
``python docs/measured/moved_chair.py [SYSTEM] [WIDTH] [FRAMES]``."""

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch

from gsfusion_nb.config import replace
from gsfusion_nb.data.room import room_mesh, room_sdf
from gsfusion_nb.evaluation.point_distances import distance_to_points
from gsfusion_nb.mapping import get_system
from gsfusion_nb.runs import run_mapping
from gsfusion_nb.runs.onto import read_parent, settings_onto

NEAR_M = 0.04
"""A point of the room is in the map if the map's surface is so near."""
system, width, frames = (*sys.argv[1:], *("gsfusion", "160", "100")[len(sys.argv) - 1 :])
SIZE: dict[str, Any] = {"n_frames": int(frames), "width": int(width), "height": 3 * int(width) // 4}


def of_chair(here: str, elsewhere: str) -> torch.Tensor:
    """Points of the room with ``moved=here`` that are on no surface of the other room."""
    xyz_W = room_mesh(0.03, moved=here).vertices_W
    return xyz_W[room_sdf(xyz_W, moved=elsewhere) > 0.06]


OLD = of_chair("none", "chair")
NEW = of_chair("chair", "none")


def both() -> torch.Tensor:
    """Points of the room that are the same in both."""
    xyz_W = room_mesh(0.03).vertices_W
    return xyz_W[room_sdf(xyz_W, moved="chair").abs() < 0.005]


def shares(run) -> dict[str, float]:
    """Shares of the points that have the run's surface nearby, and Gaussians in the old chair."""
    mapper = run.mapper
    vertices_W = mapper.mesh().vertices_W
    values = {
        name: float((distance_to_points(xyz_W, vertices_W) < NEAR_M).float().mean())
        for name, xyz_W in (("old", OLD), ("new", NEW), ("others", both()))
    }
    xyz_W = mapper.gaussians.params.xyz_W
    at_old = distance_to_points(xyz_W, OLD) < NEAR_M
    free = room_sdf(xyz_W, moved="chair") > 0.03
    return values | {"gaussians_old": int((at_old & free).sum()), "gaussians": len(xyz_W)}


with tempfile.TemporaryDirectory() as folder:
    place = Path(folder)
    preset = get_system(system).preset("room", tsdf__voxel_size_m=0.02)
    if system == "rtg_slam":
        preset = get_system(system).preset("room")
    first = run_mapping("room", preset, folder=place / "first", evaluate=False, **SIZE)
    found = {"before": shares(first)}
    for name, keeps in (("after", False), ("kept", True)):
        config = replace(settings_onto(read_parent(place / "first").config))
        run = run_mapping(
            "room",
            config,
            onto=place / "first",
            keep_moved=keeps,
            folder=place / name,
            evaluate=False,
            moved="chair",
            **SIZE,
        )
        found[name] = shares(run) | {
            "frames": len(run.run.steps),
            "ms_frame": 1e3 * run.metrics["seconds_online"] / len(run.run.steps),
        }
        found[name] |= {k: v for k, v in run.metrics.items() if k.endswith("_moved")}
print(json.dumps(found))  # noqa: T201
