"""Pictures of a map: colours, numbers and depth; states and causes of discs; the panels of one
step."""

import numpy as np
import pytest
import torch

from gsfusion_nb.config import rtg_slam
from gsfusion_nb.data import apply_options
from gsfusion_nb.gaussians import GaussianModel, SurfelModel
from gsfusion_nb.gaussians.surfels import OPAQUE, STABLE, TRANSPARENT
from gsfusion_nb.geometry import quaternion
from gsfusion_nb.mapping import make_mapper
from gsfusion_nb.render import view_surface
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.types import Camera, Frame, Seeds
from gsfusion_nb.viz import LiveMapper, orbit_camera
from gsfusion_nb.viz.map_pictures import (
    CAUSES,
    STATE_COLOURS,
    Paint,
    cause_picture,
    map_picture,
    state_picture,
)
from gsfusion_nb.viz.mapped_frame import captions_of, live_panels, mosaic

CAMERA = Camera(
    width=48,
    height=36,
    fx=40.0,
    fy=40.0,
    cx=24.0,
    cy=18.0,
)


def discs(x, opacity, tag):
    n = len(x)
    xyz = torch.tensor([[a, 0.0, 2.0] for a in x])
    return Seeds(
        xyz_W=xyz,
        rgb=torch.full((n, 3), 0.9),
        scale_m=torch.tensor([0.2, 0.2, 0.02]).expand(n, 3).clone(),
        quat=quaternion.normalise(torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(n, 4)),
        opacity=torch.tensor(opacity),
        tag=torch.tensor(tag, dtype=torch.int32),
    )


@pytest.fixture
def disc_model():
    """A stable disc at the left, an unstable one at the right, a transparent one of frame 7 in the
    middle."""
    model = SurfelModel(sh_degree=0)
    model.append(
        discs([-0.6, 0.6], [OPAQUE, OPAQUE], [1, 1]),
        0,
    )
    model.state[0] = STABLE
    model.append(discs([0.0], [TRANSPARENT], [3]), 7)
    return model


@pytest.fixture
def rtg_run(make_run):
    """RTG-SLAM over the tiny wall."""

    def make(n=8, **options):
        wall = make_run(n=n).sequence.source
        config = rtg_slam("replica", data__hold_out_every=0, sh_degree=0, **options)
        return MappingRun(apply_options(wall, config.data), make_mapper(config))

    return make


def near(picture, u, v, colour):
    """Hue of a pixel: the shaded colour of a state points the same way as the pure one."""
    a = picture[v, u].astype(float)
    b = np.array(colour, float)
    return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b)) > 0.999


def test_each_pixel_has_the_colour_of_the_state_of_its_disc(disc_model):
    view = view_surface(disc_model.params, CAMERA, torch.eye(4))
    picture = state_picture(disc_model, view, CAMERA, torch.eye(4))
    assert near(picture, 12, 18, STATE_COLOURS["stable_opaque"])
    assert near(picture, 36, 18, STATE_COLOURS["unstable_opaque"])
    assert tuple(picture[18, 24]) == STATE_COLOURS["unstable_transparent"]
    assert picture[0, 0].max() < 40


def test_only_the_discs_of_this_frame_are_painted_in_the_colour_of_their_cause(disc_model):
    rgb = torch.full((36, 48, 3), 0.5)
    frame = Frame(
        index=7,
        timestamp_s=0.7,
        rgb=rgb,
        depth_m=torch.full((36, 48), 2.0),
        camera=CAMERA,
        T_WC=torch.eye(4),
    )
    picture = cause_picture(rgb.numpy(), disc_model, frame)
    coloured = (picture.max(-1).astype(int) - picture.min(-1)) > 20
    assert coloured.sum() == 4
    assert tuple(picture[18, 24]) == CAUSES[3][1]


def test_panels_of_rtg_slam(rtg_run):
    run = rtg_run()
    report = next(run.online())
    panels = live_panels(run.mapper, run.sequence.mapping[0])
    assert list(panels) == ["input", "render", "error", "depth_error", "states", "seed_causes"]
    assert list(captions_of(run.mapper)) == [
        "input",
        "render",
        "error",
        "depth_error",
        "states",
        "seed_causes",
    ]
    assert {p.shape for p in panels.values()} == {(36, 48, 3)}
    new_area = (panels["seed_causes"] == CAUSES[1][1]).all(-1).sum()
    assert report.n_seeds / 4 < new_area <= 4 * report.n_seeds
    assert mosaic(panels, captions_of(run.mapper)).shape[1] == 3 * 48 + 2 * 6


def test_a_tracked_frame_is_drawn_at_the_pose_where_it_was_mapped(rtg_run):
    run = rtg_run(n=3)
    live = LiveMapper(run)
    live.run_sync()
    moved = run.mapper.trajectory.poses[-1].clone()
    moved[0, 3] += 0.1
    run.mapper.trajectory.poses[-1] = moved
    assert torch.equal(live._last_frame().T_WC, moved)
    run.mapper.trajectory.frame_indices[-1] = 99
    assert not torch.equal(live._last_frame().T_WC, moved)


WIDE = Camera(
    width=161,
    height=121,
    fx=120.0,
    fy=120.0,
    cx=80.5,
    cy=60.5,
)
FRONT = orbit_camera((0, 0, 0), -90, 0, 2.0)
LEFT = (60, 50)  # row, column of the two Gaussians seen from -y: 0.5 m aside at 2 m is 30 px
RIGHT = (60, 110)


def test_red_left_green_right_seen_from_minus_y(model):
    image = map_picture(model.params, WIDE, FRONT)
    assert (image.shape, image[LEFT].argmax(), image[RIGHT].argmax()) == ((121, 161, 3), 0, 1)
    behind = map_picture(
        model.params,
        WIDE,
        orbit_camera((0, 0, 0), 90, 0, 2.0),
    )
    assert behind[LEFT].argmax() == 1
    assert image[5, 80].max() == 0  # nothing there


def test_numbers_are_colours_and_depth_is_one(model):
    paint = Paint(values=model.birth_frame.float(), low=3.0, high=7.0)
    image = map_picture(model.params, WIDE, FRONT, paint=paint).astype(int)
    assert image[RIGHT][1] > 150 > 100 > image[LEFT][1]  # viridis: early dark purple, late yellow
    depth = map_picture(
        model.params,
        WIDE,
        orbit_camera((0, 0, 0), -60, 0, 2.0),
        depth=True,
    )  # the right one is nearer
    far, near = (
        np.abs(depth[:100].astype(int) - c).max(-1) < 40 for c in ((122, 4, 3), (48, 18, 59))
    )
    assert np.nonzero(far)[1].max() < 80 < np.nonzero(near)[1].min()
    empty = GaussianModel(sh_degree=0).params
    assert map_picture(empty, WIDE, torch.eye(4), depth=True).shape == (121, 161, 3)
    assert map_picture(
        model.params,
        WIDE.resized(20, 15),
        FRONT,
        depth=True,
    ).shape == (
        15,
        20,
        3,
    )
