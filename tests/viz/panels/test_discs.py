"""The scene of discs, and the masks of Eq. 6 over a frame."""

import pytest
import torch

from gsfusion_nb.render import SurfaceView
from gsfusion_nb.types import Camera, Frame
from gsfusion_nb.viz.panels.disc_adding import masks_by_cause
from gsfusion_nb.viz.panels.disc_scene import disc_scene
from gsfusion_nb.viz.panels.discs import disc_panel


def test_on_a_plane_the_disc_depth_is_exact_and_the_blended_one_is_not():
    scene = disc_scene(lean_deg=30, gap_m=0.0, spacing_m=0.2)
    assert float(scene.errors_m("disc_m").max()) < 1e-3
    assert float(scene.errors_m("blended_m").mean()) > 0.02
    assert scene.in_mid_air("disc_m") == 0.0


def test_between_two_surfaces_only_the_blended_depth_is_in_mid_air():
    scene = disc_scene(lean_deg=20, gap_m=0.8)
    assert scene.in_mid_air("disc_m") < 0.005
    assert scene.in_mid_air("blended_m") > 0.05


@pytest.mark.parametrize("lean_deg", [0, 75])
@pytest.mark.parametrize("gap_m", [0.0, 1.2])
@pytest.mark.parametrize("spacing_m", [0.05, 0.3])
def test_every_end_of_the_sliders_draws(lean_deg, gap_m, spacing_m):
    panel = disc_panel().set(lean_deg=lean_deg, gap_m=gap_m, spacing_m=spacing_m, opaque_alpha=0.95)
    assert "Error" not in panel.caption.value
    assert panel.picture().shape[1] > 800


@pytest.fixture
def scene():
    """Four pixels: fine, new, 20 cm too far, wrong colour; the last is new and wrong at once."""
    camera = Camera(
        width=5,
        height=1,
        fx=5.0,
        fy=5.0,
        cx=2.5,
        cy=0.5,
    )
    grey = torch.full((1, 5, 3), 0.5)
    other = torch.full((1, 5, 3), 0.5)
    other[0, 3:] = 0.9
    index = torch.zeros(1, 5, dtype=torch.int32)
    view = SurfaceView(
        rgb=other,
        transmittance=torch.tensor([[0.0, 0.9, 0.0, 0.0, 0.9]]),
        depth_m=torch.tensor([[2.0, 0.0, 2.2, 2.0, 2.9]]),
        normal_W=torch.zeros(1, 5, 3),
        hit_index=index,
        dominant_index=index,
    )
    frame = Frame(
        index=0,
        timestamp_s=0.0,
        rgb=grey,
        depth_m=torch.full((1, 5), 2.0),
        camera=camera,
        T_WC=torch.eye(4),
    )
    return view, frame


def test_masks_by_hand(scene):
    view, frame = scene
    masks = masks_by_cause(view, frame, 0.5, 0.1, 0.1)
    assert {cause: mask.nonzero()[:, 1].tolist() for cause, mask in masks.items()} == {
        1: [1, 4],
        2: [2],
        3: [3],
    }
