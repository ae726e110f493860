"""What a recording sees through is taken out of the map that it goes on in, and nothing else."""

import math
from typing import Any

import pytest
import torch
from earlier_runs import StopAfter

from gsfusion_nb.config import gsfusion, replace
from gsfusion_nb.data.room import room, room_mesh, room_sdf
from gsfusion_nb.evaluation.point_distances import distance_to_points
from gsfusion_nb.mapping import get_system
from gsfusion_nb.mapping.moved_surfaces import VIEWS, View, count, project_into
from gsfusion_nb.runs import CheckpointEvery, resume_mapping, run_mapping
from gsfusion_nb.runs.onto import read_parent, settings_onto
from gsfusion_nb.types import Camera, Frame

ROOM: dict[str, Any] = {"n_frames": 200, "width": 160, "height": 120}
FRAMES: dict[str, Any] = {"data__start": 64, "data__stop": 104, "data__hold_out_every": 0}
SMALL: dict[str, Any] = {
    "tsdf__voxel_size_m": 0.03,
    "tsdf__truncation_voxels": 4.0,
    "sh_degree": 0,
    "optim__global_iterations": 1,
}
NEAR_M = 0.05


def wall(depth_m: float) -> Frame:
    """A view of a wall, with one pixel without depth."""
    camera = Camera(width=16, height=12, fx=14.0, fy=14.0, cx=8.0, cy=6.0)
    depth = torch.full((12, 16), depth_m)
    depth[0, 0] = 0
    return Frame(
        index=0,
        timestamp_s=0.0,
        rgb=torch.zeros(12, 16, 3),
        depth_m=depth,
        camera=camera,
        T_WC=torch.eye(4),
    )


def votes_after(*depths_m: float, xyz_W: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Votes of points, and which moved at the last of some views of walls."""
    votes = torch.zeros(len(xyz_W), dtype=torch.uint8)
    is_moved = torch.zeros(len(xyz_W), dtype=torch.bool)
    for depth_m in depths_m:
        votes, is_moved = count(votes, View(wall(depth_m)), xyz_W)
    return votes, is_moved


def test_three_views_are_evidence_and_fewer_are_not():
    xyz_W = torch.tensor([[0.1, 0.1, 1.0], [0.1, 0.1, 1.95], [0.1, 0.1, 2.5], [5.0, 0, 1]])
    for n in range(1, VIEWS):
        votes, is_moved = votes_after(*[2.0] * n, xyz_W=xyz_W)
        assert votes.tolist() == [n, 0, 0, 0]  # free, at the wall, behind it, beside the picture
        assert not is_moved.any()
    votes, is_moved = votes_after(*[2.0] * VIEWS, xyz_W=xyz_W)
    assert is_moved.tolist() == [True, False, False, False]
    assert votes.tolist() == [0, 0, 0, 0]


def test_a_view_that_sees_the_surface_takes_a_vote_back():
    xyz_W = torch.tensor([[0.1, 0.1, 1.0]])
    votes, is_moved = votes_after(2.0, 2.0, 1.0, 2.0, xyz_W=xyz_W)
    assert votes.tolist() == [2]
    assert not is_moved.any()
    assert votes_after(2.0, 2.0, 1.0, 2.0, 2.0, xyz_W=xyz_W)[1].all()


def test_a_point_beside_an_edge_is_not_seen_through():
    frame = wall(2.0)
    frame.depth_m[:, 8:] = 1.0
    at_edge = torch.tensor([[-0.5 / 14 * 1.0, 0.0, 1.0]])  # in pixel 7, whose neighbour is near
    beside = torch.tensor([[-2.5 / 14 * 1.0, 0.0, 1.0]])
    votes, _ = count(torch.zeros(2, dtype=torch.uint8), View(frame), torch.cat([at_edge, beside]))
    assert votes.tolist() == [0, 1]


def of_chair(here: str, elsewhere: str) -> torch.Tensor:
    """Points of the chair at one of its two places."""
    xyz_W = room_mesh(0.03, moved=here).vertices_W
    return xyz_W[room_sdf(xyz_W, moved=elsewhere) > 0.08]


def share(mapper: Any, xyz_W: torch.Tensor) -> float:
    """Share of points that have the mapper's surface nearby."""
    return float((distance_to_points(xyz_W, mapper.mesh().vertices_W) < NEAR_M).float().mean())


def others() -> torch.Tensor:
    """Points that are the same in both rooms."""
    xyz_W = room_mesh(0.03).vertices_W
    return xyz_W[room_sdf(xyz_W, moved="chair").abs() < 0.005]


def ghosts(mapper: Any, old: torch.Tensor) -> int:
    """Gaussians at the old chair, in what is now free space."""
    xyz_W = mapper.gaussians.params.xyz_W
    is_free = room_sdf(xyz_W, moved="chair") > 0.06
    return int((is_free & (distance_to_points(xyz_W, old) < NEAR_M)).sum())


@pytest.fixture(scope="module")
def parent(tmp_path_factory):
    """A run on the part of the walk that shows the chair."""
    folder = tmp_path_factory.mktemp("parent") / "run"
    config = gsfusion("replica", **SMALL, **FRAMES)
    return run_mapping("room", config, folder=folder, evaluate=False, **ROOM)


def go_on(parent: Any, folder: Any, **options: Any) -> Any:
    """A run in the map of the parent, in the room with the moved chair."""
    config = replace(settings_onto(read_parent(parent.folder).config), **FRAMES)
    options = {"moved": "chair", "evaluate": False, **ROOM} | options
    return run_mapping("room", config, onto=parent.folder, folder=folder, **options)


@pytest.fixture(scope="module")
def moved(parent, tmp_path_factory):
    return go_on(parent, tmp_path_factory.mktemp("moved") / "run")


@pytest.mark.ci
def test_the_old_chair_goes_and_the_new_one_comes(parent, moved):
    old = of_chair("none", "chair")
    new = of_chair("chair", "none")
    before = share(parent.mapper, old)
    assert before > 0.8
    assert share(moved.mapper, old) < 0.05 * before
    assert share(parent.mapper, new) < 0.05
    assert share(moved.mapper, new) > 0.7
    assert share(moved.mapper, others()) > 0.99 * share(parent.mapper, others())
    assert ghosts(parent.mapper, old) > 20
    assert ghosts(moved.mapper, old) < 0.1 * ghosts(parent.mapper, old)
    numbers = moved.metrics
    assert numbers["n_voxels_moved"] > 100
    assert numbers["n_gaussians_moved"] > 20
    assert numbers["n_keyframes_moved"] > 0
    assert any("--keep-moved leaves all" in text for text in moved.run.warnings)


@pytest.mark.ci
def test_both_chairs_are_kept_where_that_is_asked_for(parent, tmp_path):
    kept = go_on(parent, tmp_path / "kept", keep_moved=True)
    old = of_chair("none", "chair")
    assert share(kept.mapper, old) > 0.95 * share(parent.mapper, old)
    assert share(kept.mapper, of_chair("chair", "none")) > 0.7
    assert ghosts(kept.mapper, old) > 0.7 * ghosts(parent.mapper, old)
    assert "n_voxels_moved" not in kept.metrics


@pytest.mark.ci
def test_where_nothing_moved_nothing_is_taken_out(parent, tmp_path):
    run = go_on(parent, tmp_path / "run", moved="none")
    surface_voxels = int((parent.mapper.volume.D.abs() < 0.25).sum())
    assert run.metrics["n_voxels_moved"] < 0.005 * surface_voxels
    assert run.metrics["n_gaussians_moved"] < 0.01 * len(parent.mapper.gaussians)
    assert run.metrics["n_keyframes_moved"] <= 2


@pytest.mark.ci
def test_a_resumed_run_takes_out_the_same(parent, moved, tmp_path):
    options = {"watch": StopAfter(9), "checkpoints": CheckpointEvery(frames=1)}
    with pytest.raises(RuntimeError, match="stopped"):
        go_on(parent, tmp_path / "run", **options)
    resumed = resume_mapping(tmp_path / "run", evaluate=False)
    assert resumed.run.hashes == moved.run.hashes
    for name in ("n_voxels_moved", "n_gaussians_moved", "n_keyframes_moved"):
        assert resumed.metrics[name] == moved.metrics[name]


@pytest.mark.ci
@pytest.mark.parametrize("system", ["rtg_slam", "gps_slam"])
def test_other_systems_take_out_what_moved(system, tmp_path):
    config = get_system(system).preset("replica", **FRAMES, data__stride=2)
    parent = run_mapping("room", config, folder=tmp_path / "first", evaluate=False, **ROOM)
    old = of_chair("none", "chair")
    run = go_on(parent, tmp_path / "second")
    before = share(parent.mapper, old)
    assert before > 0.4
    assert share(run.mapper, old) < 0.35 * before
    assert math.isfinite(run.metrics["n_gaussians_moved"])


def test_the_room_with_a_moved_chair_has_the_truth():
    old = of_chair("none", "chair")
    new = of_chair("chair", "none")
    assert len(old) > 300
    assert len(new) > 300
    assert abs(float(old[:, 0].mean()) - 1.58) < 0.15
    assert abs(float(new[:, 0].mean()) - 0.45) < 0.15
    assert room(**ROOM).content != room(**ROOM, moved="chair").content
    with pytest.raises(ValueError, match="moved must be one of none, chair"):
        room(moved="sofa")


def test_points_beside_the_picture_count_within_the_margin_on_every_side():
    camera = Camera(width=16, height=12, fx=20.0, fy=20.0, cx=8.0, cy=6.0)
    just_outside_px = torch.tensor(
        [[-0.5, 6.0], [16.5, 6.0], [8.0, -0.5], [8.0, 12.5], [8.0, 6.0]],
        dtype=torch.float64,
    )
    z = 2.0
    xyz = torch.cat(
        [
            (just_outside_px - torch.tensor([camera.cx, camera.cy])) * z / camera.fx,
            torch.full((5, 1), z, dtype=torch.float64),
        ],
        dim=1,
    )
    T_WC = torch.eye(4).double()
    for margin_m, beside in ((0.0, False), (0.04, False), (0.06, True)):  # 0.5 pixel is 0.05 m
        is_inside = project_into(camera, T_WC, xyz, margin_m)[3]
        assert is_inside.tolist() == [beside] * 4 + [True]
