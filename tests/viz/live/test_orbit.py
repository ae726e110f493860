"""The orbit viewer without a browser: moving a slider changes the picture, and the picture shows what it should."""

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.config import gps_slam, rtg_slam
from gsfusion_nb.drawing.pictures import to_uint8
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.mapping import RTGSLAM, make_mapper
from gsfusion_nb.types import Seeds
from gsfusion_nb.viz import orbit_view
from gsfusion_nb.viz.display import WIDGET_MIME
from gsfusion_nb.viz.live import orbit


def shown(view):
    return np.asarray(cv2.imdecode(np.frombuffer(view.image.value, np.uint8), cv2.IMREAD_COLOR))[..., ::-1]


@pytest.fixture
def view(model):
    return orbit_view(model, size=(160, 120))


def test_sliders_move_the_camera_and_the_picture(view):
    view.set(azimuth_deg=-90, elevation_deg=0, distance_m=2.0)
    front = shown(view)
    assert np.abs(front.astype(int) - view.picture()).max() < 30  # what JPEG does to it
    assert front[60, :80, 0].max() > 200 > front[60, 80:, 0].max() + 50  # red left
    view.sliders["azimuth"].value = 90
    assert shown(view)[60, 80:, 0].max() > 200  # red right
    view.set(distance_m=4.0)
    assert (shown(view).max(-1) > 60).sum() < (front.max(-1) > 60).sum() / 2


def test_dragging_the_picture_turns_the_camera(view):
    view.set(azimuth_deg=-90, elevation_deg=0, distance_m=2.0)
    view.image.stroke = [1, 0, 80.0, 60.0, 96.0, 68.0]
    assert (view.sliders["azimuth"].value, view.sliders["elevation"].value) == (-110, 10)
    assert float(view.pose()[0, 3]) < -0.5  # the camera went left and up, so that the scene follows the pointer
    assert float(view.pose()[2, 3]) > 0.2
    assert "azimuth -110" in view.image.alt
    view.image.stroke = [2, 1, 80.0, 60.0, 80.0, 96.0]
    assert view.sliders["distance"].value == pytest.approx(2 * np.e, abs=0.03)
    view.look_from("inside").image.stroke = [3, 0, 80.0, 60.0, 96.0, 60.0]
    assert view.sliders["azimuth"].value == 98  # standing at the target, it looks around


def test_show_and_cut(view):
    view.set(azimuth_deg=0, elevation_deg=0, distance_m=2.0)
    assert shown(view)[60, 80].argmax() == 1
    view.sliders["cut"].value = 2.0
    assert shown(view)[60, 80].argmax() == 0
    pictures = []
    for show in view.show.options:
        view.show.value = show
        pictures.append(shown(view).tobytes())
    assert len(set(pictures)) == len(pictures) == 5


def test_places_and_their_buttons(view):
    view.buttons["inside"].click()
    assert view.sliders["distance"].value == 0
    view.buttons["above"].click()
    assert view.sliders["elevation"].value > 45
    assert view.sliders["cut"].value > 0
    with pytest.raises(KeyError, match="no viewpoint 'below'"):
        view.look_from("below")


def test_it_follows_a_growing_map(view, model):
    view.set(azimuth_deg=-90, elevation_deg=0, distance_m=2.0)
    before = shown(view)
    model.append(Seeds.isotropic(torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([0.2]), opacity=0.99))
    view.sliders["elevation"].value = 1
    assert shown(view)[60, 80, 2] > 200 > before[60, 80, 2]
    assert "3 Gaussians" in view.caption.value


def test_bare_parameters_have_no_labels(model):
    view = orbit_view(model.params, size=(160, 120))
    assert view.show.options == ("colour", "depth", "opacity")


def test_an_empty_map_is_shown():
    assert shown(orbit_view(GaussianModel(sh_degree=0), size=(64, 48))).shape == (48, 64, 3)


def test_a_mapper_starts_at_its_first_keyframe(make_run):
    run = make_run()
    next(run.online())
    frame = run.sequence.mapping[0]
    assert len(run.mapper.keyframes) == 1
    view = orbit_view(run.mapper, size=(48, 36))
    assert view.up_W.tolist() == [0, -1, 0]
    assert torch.allclose(view.pose(), frame.T_WC, atol=0.03)  # sliders stand on steps of 5 cm
    error = np.abs(view.picture().astype(float) - frame.rgb.numpy() * 255).mean()
    assert error < 60  # the stripes, blurred; another view would be far off
    view.set(azimuth_deg=0)
    assert np.abs(view.picture().astype(float) - frame.rgb.numpy() * 255).mean() > 1.5 * error


def test_stored_and_live_outputs(view, monkeypatch):
    for name in ("GSNB_VIEW", "GSNB_SMOKE"):
        monkeypatch.delenv(name, raising=False)
    bundle = view._repr_mimebundle_()[0]
    assert {WIDGET_MIME, "image/jpeg", "text/plain"} <= set(bundle)
    monkeypatch.setenv("GSNB_VIEW", "static")
    assert WIDGET_MIME not in view._repr_mimebundle_()[0]


def test_a_moved_slider_renders_once(view, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        orbit, "draw_gaussians", lambda *a, whole=orbit.draw_gaussians, **k: drawn.append(0) or whole(*a, **k)
    )
    view.sliders["azimuth"].value = 40
    assert len(drawn) == 1
    view.set(azimuth_deg=20, elevation_deg=10, distance_m=3.0)
    assert len(drawn) == 2


def test_a_map_of_discs_has_no_levels(model):
    mapper = RTGSLAM(rtg_slam("room"))
    params = model.params
    mapper.gaussians.append(
        Seeds(
            xyz_W=params.xyz_W,
            rgb=model.rgb,
            scale_m=model.scale_m,
            quat=params.quat,
            opacity=model.opacity,
            tag=model.tag,
        )
    )
    view = orbit_view(mapper, size=(160, 120))
    assert view.show.options == ("colour", "depth", "opacity", "first-seen frame")
    assert shown(view.set(azimuth_deg=-90, elevation_deg=0, distance_m=2.0)).max() > 150


def test_a_map_over_a_surface_is_shown_with_its_surface(small_room):
    mapper = make_mapper(gps_slam("room", data__width=80, data__height=60, tsdf__voxel_size_m=0.05))
    for i in range(2):
        mapper.step(small_room[i])
    view = orbit_view(mapper, size=(80, 60))
    assert not len(mapper.gaussians)  # all that there is to see is the surface
    drawn = to_uint8(mapper.render(view.camera, view.pose()).rgb)
    assert drawn.max() > 60
    assert np.array_equal(view.picture(), drawn)
    view.set(cut_m=0.5)
    assert view.picture().max() > 60  # as discs
    view.set(cut_m=0.0, show="first-seen frame")
    assert view.picture().shape == (60, 80, 3)
