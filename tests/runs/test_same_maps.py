"""The same input gives the same maps, bit for bit, for any number of threads, with a resume in
between."""

from typing import Any

import numba
import pytest
import torch

from gsfusion_nb.config import gps_slam, replace, rtg_slam
from gsfusion_nb.data import open_sequence
from gsfusion_nb.mapping import make_mapper
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.runs.checkpoint import save_checkpoint
from gsfusion_nb.runs.map_hashes import hash_of, map_hashes
from gsfusion_nb.runs.resume import load_run

ROOM: dict[str, Any] = {"n_frames": 120, "width": 80, "height": 60}
FEW_STEPS = {
    "gsfusion": {
        "optim__keyframe_iterations": 3,
        "optim__frame_iterations": 2,
        "optim__random_keyframe_iterations": 1,
    },
    "rtg_slam": {"window__iterations": 8, "keyframes__iterations": 4},
    "gps_slam": {
        "schedule__every_frames": 2,
        "schedule__window_every": 2,
        "schedule__iterations": 6,
    },
}


def mapped(config, folder, threads: int) -> dict[str, str]:
    """Hashes of the maps of seven frames and a pass; in between the run is saved and loaded."""
    torch.set_num_threads(threads)
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))  # pyright: ignore[reportAttributeAccessIssue]
    source = {"path_or_name": "room", **ROOM}
    run = MappingRun(
        open_sequence(**source, data=config.data),
        make_mapper(config),
        source=source,
    )
    for _ in zip(range(4), run.online(), strict=False):
        pass
    save_checkpoint(run, folder / f"{threads}")
    run = load_run(folder / f"{threads}")
    list(run.online())
    list(run.optimise())
    return map_hashes(run, run.mapper.mesh())


@pytest.mark.parametrize(
    "threads",
    [(1, 3), pytest.param((1, 2, 4), marks=pytest.mark.ci)],
    ids=str,
)
@pytest.mark.parametrize("poses", ["given", "tracked"])
@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam", "gps_slam"])
def test_threads_do_not_change_the_maps(tmp_path, config, system, poses, threads):
    small = {
        "tracking__poses": poses,
        "data__stop": 7,
        "data__hold_out_every": 0,
        **FEW_STEPS[system],
    }
    if system == "gsfusion":
        settings = replace(config, optim__global_iterations=1, **small)
    elif system == "gps_slam":
        rule = {"seeding__rule": "uniform", "seeding__options": {}}
        size = {"data__width": 0, "data__height": 0, "tsdf__voxel_size_m": 0.04}
        settings = gps_slam("room", final__passes=1, **rule, **size, **small)
    else:
        settings = rtg_slam("room", data__width=0, data__height=0, final__passes=1, **small)
    before = torch.get_num_threads(), numba.get_num_threads()
    try:
        hashes = [mapped(settings, tmp_path, n) for n in threads]
    finally:
        torch.set_num_threads(before[0])
        numba.set_num_threads(before[1])
    assert all(each == hashes[0] for each in hashes)
    assert set(hashes[0]) >= {"gaussians", "trajectory", "mesh"}


def test_a_hash_tells_values_types_and_shapes_apart():
    a = torch.tensor([1.0, 2.0])
    same = hash_of({"x": a, "y": torch.arange(3)})
    assert hash_of({"y": torch.arange(3), "x": a.clone()}) == same
    others = (
        {"x": a},
        {"x": a + 1},
        {"z": a},
        {"x": a[:, None]},
        {"x": a.double()},
        {"x": -a * 0},
        {"x": a * 0},
    )
    assert len({hash_of(o) for o in others}) == len(others)
