"""Every picture of the panels has words, every control a name, and everything that can be dragged has sliders too."""

import ipywidgets as w
import pytest
import torch

from gsfusion_nb.compare.bench.scene import random_scene
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import TsdfVolume
from gsfusion_nb.types import Camera, Frame
from gsfusion_nb.viz import (
    GradientMicroscope,
    LiveLoop,
    LiveMapper,
    PixelMicroscope,
    amdahl_panel,
    disc_panel,
    frame_surface,
    icp_panel,
    one_gaussian_panel,
    point_panel,
    quadtree_panel,
    sh_ball_panel,
    tsdf_fill_panel,
)
from gsfusion_nb.viz.display import ClickImage, LostNotice

CAMERA = Camera(width=48, height=36, fx=40.0, fy=40.0, cx=24.0, cy=18.0)
_FRAME = Frame(
    index=0, timestamp_s=0.0, rgb=torch.rand(36, 48, 3, generator=torch.Generator().manual_seed(0)),
    depth_m=torch.full((36, 48), 1.5), camera=CAMERA, T_WC=torch.eye(4),
)  # fmt: skip


def _scene():
    return random_scene(20, CAMERA.width, CAMERA.height)


def _microscope(kind):
    scene = _scene()
    return kind(scene.params, scene.camera, scene.T_WC, *([_FRAME.rgb] if kind is GradientMicroscope else []))


def _loop():
    return LiveLoop(lambda: iter([1]), lambda: _FRAME.colour.mul(255).byte().numpy(), {"loss": []}, n_steps=1)


MAKERS = {
    "quadtree": lambda: quadtree_panel(_FRAME.rgb),
    "points": lambda: point_panel(_FRAME),
    "fill": lambda: tsdf_fill_panel(TsdfVolume(TsdfConfig(voxel_size_m=0.1)), CAMERA, lambda T_WC: _FRAME),
    "one Gaussian": lambda: one_gaussian_panel(CAMERA),
    "ball": sh_ball_panel,
    "discs": disc_panel,
    "icp": lambda: icp_panel(_FRAME, frame_surface(_FRAME)),
    "amdahl": lambda: amdahl_panel({"seed": 0.1, "optimise": 0.3}),
    "pixel": lambda: _microscope(PixelMicroscope),
    "gradient": lambda: _microscope(GradientMicroscope),
    "loop": _loop,
}


def widgets_of(widget):
    """The widget and all that it contains."""
    yield widget
    for child in getattr(widget, "children", ()):
        yield from widgets_of(child)


def check_words(root):
    every = list(widgets_of(root))
    assert not [x for x in every if isinstance(x, w.Image)], "a plain Image has no words for screen readers"
    for picture in (x for x in every if isinstance(x, ClickImage)):
        assert len(picture.alt) > 8, picture
    for control in (x for x in every if hasattr(x, "description") and not isinstance(x, w.HTML | w.IntProgress)):
        assert control.description or control.tooltip, control
    assert sum(isinstance(x, LostNotice) for x in every) == 1


@pytest.mark.parametrize("name", MAKERS)
def test_pictures_have_words_and_controls_have_names(name):
    panel = MAKERS[name]()
    check_words(panel.widget)
    data, words = panel._repr_mimebundle_()
    assert all(words[kind]["alt"] for kind in data if kind.startswith("image/"))
    touched = [x for x in widgets_of(panel.widget) if isinstance(x, ClickImage) and x.touch == "stroke"]
    sliders = [x for x in widgets_of(panel.widget) if isinstance(x, w.IntSlider | w.FloatSlider)]
    assert len(sliders) >= 2 or not touched


def test_the_live_mapper_has_words(make_run):
    check_words(LiveMapper(make_run()).widget)
