"""Importing the room of pictures is light; pictures keep the size of their labels, and have
words."""

import subprocess
import sys
from typing import Any

import cv2
import numpy as np
import pytest

from gsfusion_nb.drawing.pictures import LABEL_PX
from gsfusion_nb.viz import curve_figure, show, show_figure


def test_viz_is_light_and_complete():
    code = (
        "import sys, gsfusion_nb.viz as v; heavy = [m for m in ('ipywidgets', 'pyvista', "
        "'matplotlib', 'cv2', 'IPython') if m in sys.modules]; from gsfusion_nb.viz import "
        "LiveMapper, Player, SplatViewer, map_picture, orbit_camera, show, show_mesh; late = [m "
        "for m in ('pyvista', 'matplotlib') if m in sys.modules]; missing = [n for n in v.__all__ "
        "if not callable(getattr(v, n))]; print(heavy, late, missing)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "[] [] []"


def shown(image):
    return np.asarray(cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR))


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_labels_keep_their_size_when_pictures_are_scaled(scale):
    picture = np.full((40, 60, 3), 128, np.uint8)
    image = show([picture, picture], ["left", "right"], scale=scale)
    height, width = shown(image).shape[:2]
    assert image.width == width
    assert height == LABEL_PX + round(40 * scale)
    assert width == pytest.approx(2 * 60 * scale, abs=8)


def test_pictures_have_words_for_those_who_do_not_see_them():
    picture = np.full((40, 60, 3), 128, np.uint8)
    assert show([picture, picture], ["left", "right"]).alt == "left; right"
    assert show(picture, alt="grey").alt == "grey"
    graph = show_figure(
        curve_figure([0, 1], {"a": [1.0, 2.0]}, x_label="frame", y_label="PSNR, dB"),
        width=480,
    )
    assert graph.alt == "Graph of PSNR, dB over frame: a"
    bundle: Any = graph._repr_mimebundle_()
    assert bundle[1]["image/png"]["alt"] == graph.alt
    assert graph.width == 480
