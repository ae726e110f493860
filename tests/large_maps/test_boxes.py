"""Boxes around chunks: nothing that reaches a picture is left out, and boxes follow the map."""

import dataclasses

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import OptimConfig, gps_slam, gsfusion, replace, rtg_slam
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.geometry import se3
from gsfusion_nb.large_maps import Boxes, MapPart, MapParts, drawn_in_part, farthest_depth
from gsfusion_nb.large_maps import boxes as row_boxes
from gsfusion_nb.large_maps.chunks import CHUNK, GRID
from gsfusion_nb.mapping import GPSSLAM, RTGSLAM, GSFusion
from gsfusion_nb.optim import Keyframe, adam_step
from gsfusion_nb.render import render, rows_in_view
from gsfusion_nb.types import ALL_ROWS, Camera, GaussianParams

CAMERA = Camera(
    width=64,
    height=48,
    fx=50.0,
    fy=55.0,
    cx=30.0,
    cy=27.0,
)


@pytest.fixture(autouse=True)
def _small_maps_in_chunks(monkeypatch):
    monkeypatch.setattr(row_boxes, "MOSTLY_SEEN", 0.99)
    monkeypatch.setattr(row_boxes, "WHOLE_BELOW", 0)


@pytest.fixture
def cloud(generator):
    """A walk through 10 x 10 x 3 m, as a mapper adds Gaussians: neighbours are near each other."""
    n = 20 * CHUNK + 7
    at = torch.linspace(0, 6.28, n)
    middle = 4 * torch.stack(
        [at.cos(), (2 * at).sin(), 0.3 * at.sin()],
        1,
    )
    return GaussianParams(
        xyz_W=middle + 0.5 * torch.randn(n, 3, generator=generator),
        log_scale=-3 + 0.7 * torch.randn(n, 3, generator=generator),
        quat=torch.randn(n, 4, generator=generator),
        opacity_logit=2 * torch.randn(n, generator=generator),
        sh=torch.randn(n, 1, 3, generator=generator),
    )


def poses(generator, n):
    for _ in range(n):
        xi = torch.randn(6, generator=generator) * torch.tensor([2.0, 2.0, 2.0, 2.0, 2.0, 1.0])
        yield se3.exp(xi)


def chosen(boxes, params, T_WC, camera=CAMERA, depth_m=None):
    rows = boxes.rows(params, camera, T_WC, depth_m)
    assert isinstance(rows, torch.Tensor)
    return rows


def test_the_picture_of_the_part_is_that_of_the_map(cloud, generator):
    boxes = Boxes()
    shares = []
    for T_WC in poses(generator, 25):
        rows = chosen(boxes, cloud, T_WC)
        shares.append(len(rows) / len(cloud))
        left_out = torch.ones(len(cloud), dtype=torch.bool)
        left_out[rows] = False
        assert not (rows_in_view(cloud, CAMERA, T_WC) & left_out).any()
        whole = render(cloud, CAMERA, T_WC)
        part = drawn_in_part(
            lambda p, T=T_WC: render(p, CAMERA, T),
            cloud,
            boxes,
            CAMERA,
            T_WC,
        )
        for name in ("rgb", "depth_m", "alpha", "first_index", "dominant_index"):
            assert torch.equal(getattr(part, name), getattr(whole, name))
    assert sum(shares) / len(shares) < 0.7


def test_a_chunk_with_a_nan_counts_as_in_view(cloud):
    cloud.xyz_W[5] = torch.nan
    T_WC = torch.eye(4)
    T_WC[:3, 3] = 100.0
    assert chosen(Boxes(), cloud, T_WC).tolist() == list(range(CHUNK))


def test_few_rows_are_not_chosen_from(cloud, monkeypatch):
    monkeypatch.setattr(row_boxes, "WHOLE_BELOW", len(cloud) + 1)
    assert Boxes().rows(cloud, CAMERA, torch.eye(4)) is ALL_ROWS


def test_chunks_behind_a_wall_are_left_out_where_its_depth_is_known(generator):
    n = CHUNK
    spread = 0.05 * torch.rand(3 * n, 3, generator=generator)
    z = torch.tensor([2.0, 2.3, 4.0]).repeat_interleave(n)
    cloud = GaussianParams(
        xyz_W=spread + torch.stack([0 * z, 0 * z, z], 1),
        log_scale=torch.full((3 * n, 3), -5.0),
        quat=torch.ones(3 * n, 4),
        opacity_logit=torch.zeros(3 * n),
        sh=torch.zeros(3 * n, 1, 3),
    )
    wall = torch.full((48, 64), 2.0)
    hole = wall.clone()
    hole[20:36, 20:44] = 0.0
    small = torch.full(GRID, 2.0)
    small[5:7, 7:9] = 0.0  # of the size of a grid, but with depth that is missing
    grid = farthest_depth(wall)
    for depth_m, chunks in (
        (wall, [0, 1]),
        (grid, [0, 1]),
        (small, ALL_ROWS),
        (hole, ALL_ROWS),
        (0 * wall, ALL_ROWS),
        (None, ALL_ROWS),
    ):
        rows = Boxes().rows(cloud, CAMERA, torch.eye(4), depth_m)
        assert (rows if isinstance(rows, slice) else sorted(set((rows // n).tolist()))) == chunks


def test_boxes_follow_the_map(cloud, generator):
    model = GaussianModel(0)
    boxes = Boxes()
    T_WC = torch.eye(4)
    model.extend(cloud)
    boxes.rows(model.params, CAMERA, T_WC)
    rows = torch.arange(3 * CHUNK, 5 * CHUNK)
    part = MapPart(model, rows, boxes)
    part.params.xyz_W.add_(3.0)
    part.params.log_scale.add_(1.0)
    part.write_back()
    known = boxes._edits
    for T_WC in poses(generator, 5):
        assert torch.equal(
            chosen(boxes, model.params, T_WC),
            chosen(Boxes(), model.params, T_WC),
        )
    assert boxes._edits == known  # was not made anew
    model.params.xyz_W[0].add_(50.0)
    model.keep(torch.arange(len(model)) != 9)
    for T_WC in poses(generator, 5):
        assert torch.equal(
            chosen(boxes, model.params, T_WC),
            chosen(Boxes(), model.params, T_WC),
        )


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_boxes_follow_steps_on_the_whole_map(cloud, generator, backend):
    model = GaussianModel(0)
    boxes = Boxes()
    model.extend(cloud)
    gradients = dataclasses.replace(cloud, xyz_W=torch.randn(len(cloud), 3, generator=generator))
    T_WC = torch.eye(4)
    before = chosen(boxes, model.params, T_WC)
    for _ in range(3):
        with use_backend(backend):
            adam_step(model, gradients, OptimConfig(lr_xyz=0.03, adam_steps="none"))
        assert torch.equal(
            chosen(boxes, model.params, T_WC),
            chosen(Boxes(), model.params, T_WC),
        )
    assert not torch.equal(chosen(boxes, model.params, T_WC), before)


COARSE = {"tsdf__voxel_size_m": 0.08}
STEPS = {"optim__keyframe_iterations": 2, "optim__frame_iterations": 2}


@pytest.mark.parametrize(
    ("system", "config"),
    [
        (GSFusion, replace(gsfusion("room"), **STEPS, **COARSE)),
        (GPSSLAM, replace(gps_slam("room"), **COARSE)),
        (RTGSLAM, replace(rtg_slam("room"), window__iterations=4, keyframes__iterations=2)),
    ],
)
def test_mapping_in_parts(system, config, small_room, monkeypatch):
    whole = system(config)
    parts = system(config)
    for frame in (small_room[0], small_room[1]):
        monkeypatch.setattr(row_boxes, "WHOLE_BELOW", 10**9)
        whole.step(frame)
        monkeypatch.setattr(row_boxes, "WHOLE_BELOW", 0)
        parts.step(frame)
    assert len(parts.gaussians) == pytest.approx(len(whole.gaussians), rel=0.05)
    shown = [mapper.render(frame.camera, frame.T_WC).rgb for mapper in (whole, parts)]
    assert (shown[0] - shown[1]).abs().mean() < 0.01


def test_a_step_leaves_what_no_view_shows_as_it_is(small_room, cloud):
    mapper = GSFusion(replace(gsfusion("room"), sh_degree=0, **STEPS, **COARSE))
    far = dataclasses.replace(cloud, xyz_W=cloud.xyz_W + 100.0)
    mapper.files.begin_with(far)
    mapper.step(small_room[0])
    steps = mapper.gaussians.clock.count
    assert steps > 0
    n = len(far) // CHUNK * CHUNK  # the last chunk has new rows, too
    for name in vars(far):
        assert torch.equal(
            getattr(mapper.gaussians.params, name)[:n],
            getattr(far, name)[:n],
        )
    assert (mapper.gaussians.moments.exp_avg.sh[len(far) :] != 0).any()


@pytest.mark.parametrize("start", [0, 5, CHUNK, 700])
def test_boxes_grow_with_the_map(cloud, generator, start):
    model = GaussianModel(0)
    boxes = Boxes()
    T_WC = torch.eye(4)
    model.extend(cloud[:start])
    boxes.rows(model.params, CAMERA, T_WC)
    with boxes.appending(model):
        model.extend(cloud[start:])
    known = boxes._edits
    for T_WC in poses(generator, 5):
        assert torch.equal(
            chosen(boxes, model.params, T_WC),
            chosen(Boxes(), model.params, T_WC),
        )
    assert boxes._edits == known
    with boxes.appending(model):
        pass
    model.params.xyz_W.add_(1.0)
    with boxes.appending(model):
        model.extend(cloud[:3])
    for T_WC in poses(generator, 5):
        assert torch.equal(
            chosen(boxes, model.params, T_WC),
            chosen(Boxes(), model.params, T_WC),
        )


def test_a_second_step_on_a_view_takes_the_same_rows_and_can_be_undone(small_room, cloud):
    mapper = GSFusion(replace(gsfusion("room"), sh_degree=0, **STEPS, **COARSE))
    mapper.files.begin_with(cloud)
    frame = small_room[0]
    part = mapper.parts.in_view(frame)
    part.params.xyz_W.add_(1.0)
    part.write_back()
    before = mapper.gaussians.columns.snapshot()
    undo = mapper.gaussians.undo_log.begin()
    assert mapper.parts.in_view(frame) is part
    part.params.xyz_W.add_(1.0)
    part.write_back()
    assert not torch.equal(before["xyz_W"], mapper.gaussians.params.xyz_W)
    undo()
    assert all(
        torch.equal(before[name], column) for name, column in mapper.gaussians.columns.items()
    )
    assert mapper.parts.in_view(frame) is not part


def test_steps_on_several_views_share_one_part(small_room, cloud):
    mapper = GSFusion(replace(gsfusion("room"), sh_degree=0, **STEPS, **COARSE))
    mapper.files.begin_with(cloud)
    params = mapper.gaussians.params
    views = [Keyframe.of(small_room[i]) for i in (0, 4, 8)]
    seen = [
        chosen(
            mapper.parts.boxes,
            params,
            view.T_WC,
            view.camera,
            view.farthest_m,
        )
        for view in views
    ]
    part = mapper.parts.in_view(views[0], views[1:])
    assert isinstance(part, MapPart)
    assert isinstance(part.rows, torch.Tensor)
    assert torch.equal(part.rows, torch.cat(seen).unique())
    assert mapper.parts.in_view(views[1], views[2:]) is part
    assert (
        mapper.parts.in_view(
            views[1],
            [Keyframe.of(small_room[1])],
        )
        is not part
    )


def test_no_part_is_kept_from_one_frame_to_the_next(small_room, cloud):
    """A run that is resumed between them has none, and should go on with the same bits."""
    mapper = GPSSLAM(replace(gps_slam("room"), **COARSE, schedule__iterations=0))
    mapper.files.begin_with(cloud)
    mapper.step(small_room[0])
    view = Keyframe.of(small_room[4])
    part = mapper.parts.in_view(view)
    mapper.step(small_room[1])
    assert isinstance(part, MapPart)
    assert part.is_current
    assert mapper.parts.in_view(view) is not part


@pytest.mark.parametrize(
    "rule",
    [
        {},
        pytest.param(
            {
                "seeding__rule": "default_strategy",
                "seeding__options": {"seeds_by": "uniform", "share": 0.02},
            },
            marks=pytest.mark.ci,
        ),
    ],
)
def test_steps_of_gps_slam_in_parts_are_those_on_the_whole_map(rule, small_room, monkeypatch):
    maps = []
    monkeypatch.setattr(
        row_boxes, "MOSTLY_SEEN", 2.0
    )  # a part even if it is all of a map this small
    for whole_below in (10**9, 0):
        monkeypatch.setattr(row_boxes, "WHOLE_BELOW", whole_below)
        mapper = GPSSLAM(replace(gps_slam("room"), **rule, **COARSE))
        for i in range(14):
            mapper.step(small_room[i])
        maps.append(mapper.gaussians)
    assert maps[0].clock.count == maps[1].clock.count > 4
    assert len(maps[0]) == len(maps[1]) > 0
    for name, column in vars(maps[0].params).items():
        torch.testing.assert_close(
            getattr(maps[1].params, name),
            column,
            atol=1e-3,
            rtol=1e-3,
        )


def test_a_picture_by_depth_has_nothing_far_behind_it(generator):
    n = CHUNK
    z = torch.tensor([2.0, 4.0]).repeat_interleave(n)
    cloud = GaussianParams(
        xyz_W=torch.stack([0 * z, 0 * z, z], 1) + 0.05 * torch.rand(2 * n, 3, generator=generator),
        log_scale=torch.full((2 * n, 3), -4.0),
        quat=torch.ones(2 * n, 4),
        opacity_logit=torch.zeros(2 * n),
        sh=torch.zeros(2 * n, 1, 3),
    )
    wall = torch.full((48, 64), 2.0)
    T_WC = torch.eye(4)
    shown = drawn_in_part(
        lambda p: render(p, CAMERA, T_WC),
        cloud,
        Boxes(),
        CAMERA,
        T_WC,
        wall,
    )
    assert torch.equal(shown.rgb, render(cloud[:n], CAMERA, T_WC).rgb)
    assert shown.first_index is not None
    assert int(shown.first_index.max()) < n


def test_what_numpy_writes_between_two_frames_is_seen_in_the_next(cloud):
    model = GaussianModel(0)
    model.extend(cloud)
    parts = MapParts(model, None, lambda view: None)
    T_WC = torch.eye(4)
    before = chosen(parts.boxes, model.params, T_WC)
    model.params.xyz_W.numpy()[:] += 3.0
    parts.end_frame()
    after = chosen(parts.boxes, model.params, T_WC)
    assert torch.equal(after, chosen(Boxes(), model.params, T_WC))
    assert not torch.equal(after, before)
