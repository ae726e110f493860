"""The plain code alone runs all systems, from the first frame to the report."""

import json
from typing import Any

import pytest

from gsfusion_nb import backends
from gsfusion_nb.backends import dispatch, use_backend
from gsfusion_nb.config import gps_slam, gsfusion, rtg_slam
from gsfusion_nb.runs import run_mapping

SIZES = {"gsfusion": (48, 36), "rtg_slam": (80, 60), "gps_slam": (48, 36)}
"""Of the pictures: RTG-SLAM's discs, a pixel wide at first, need more of them to cover the
walls."""
FOUR_FRAMES: dict[str, Any] = {
    "data__stop": 4,
    "data__hold_out_offset": 2,
    "data__hold_out_every": 4,
}
CONFIGS = {
    "gsfusion": gsfusion(
        "replica",
        tsdf__voxel_size_m=0.05,
        seeding__quadtree_threshold=0.01,
        keyframe_min_seeds=20,
        optim__keyframe_iterations=4,
        optim__frame_iterations=2,
        optim__random_keyframe_iterations=1,
        optim__global_iterations=1,
        sh_degree=1,
        **FOUR_FRAMES,
    ),
    "rtg_slam": rtg_slam(
        "replica",
        window__every_frames=2,
        window__iterations=3,
        keyframes__iterations=3,
        final__passes=1,
        **FOUR_FRAMES,
    ),
    "gps_slam": gps_slam(
        "replica",
        tsdf__voxel_size_m=0.05,
        seeding__rule="uniform",
        seeding__options={},
        schedule__every_frames=2,
        schedule__window_every=2,
        schedule__iterations=4,
        final__passes=1,
        **FOUR_FRAMES,
    ),
}


@pytest.fixture
def used(monkeypatch):
    """Backends whose implementation of an operation was used."""
    found = set()
    select = dispatch._implementation

    def note(name, args, kwargs):
        implementation = select(name, args, kwargs)
        found.add(
            next(
                (b for b in backends.BACKENDS[1:] if implementation.__module__.endswith(f".{b}")),
                "reference",
            )
        )
        return implementation

    monkeypatch.setattr(dispatch, "_implementation", note)
    return found


@pytest.mark.parametrize("system", CONFIGS)
def test_from_the_first_frame_to_the_report(system, tmp_path, used):
    width, height = SIZES[system]
    with use_backend("reference"):
        run = run_mapping(
            "room",
            CONFIGS[system],
            folder=tmp_path / "out",
            n_frames=120,
            width=width,
            height=height,
        )
    assert used == {"reference"}
    numbers = json.loads((run.folder / "metrics.json").read_text())
    assert numbers["status"] == "complete"
    assert numbers["metrics"]["n_frames"] == 3
    assert numbers["metrics"]["psnr_held_out_db"] > 12
    assert numbers["metrics"]["n_triangles"] > 500
    assert (run.folder / "report.html").read_text().count("data:image") >= 6
