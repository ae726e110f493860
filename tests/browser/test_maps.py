"""The finished maps as a person looks at them: Gaussians to turn, a volume to fill; without a
network."""

import base64
import time

import cv2
import numpy as np
import pytest

pytestmark = [pytest.mark.ci, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

MAP = """
import torch
torch.set_num_threads(1)
from gsfusion_nb import GSFusion, gsfusion, open_sequence
from gsfusion_nb.viz import SplatViewer, tsdf_fill_panel, point_panel
config = gsfusion("room", tsdf__voxel_size_m=0.02)
walk = open_sequence("room", data=config.data, n_frames=60)
mapper = GSFusion(config)
for i in range(6):
    mapper.step(walk.mapping[i])
"""
SPLATS = """
splats = SplatViewer(mapper)
splats
"""
POINTS = """
points = point_panel(walk.mapping[0])
points
"""
FILL = """
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.tsdf import TsdfVolume
camera = walk.mapping[0].camera
volume = TsdfVolume(TsdfConfig(voxel_size_m=0.04))
fill = tsdf_fill_panel(volume, camera, lambda T_WC: walk.mapping[0])
fill
"""


@pytest.fixture(scope="module")
def page(lab):
    page = lab.open([MAP, SPLATS, POINTS, FILL])
    yield page
    page.close()


def splat_pixels(page):
    url = page.evaluate("document.querySelector('.gsnb-splat-software').toDataURL('image/png')")
    png = np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8)
    return np.asarray(cv2.imdecode(png, cv2.IMREAD_COLOR))[..., ::-1].astype(int)


def test_the_splat_viewer_goes_to_other_places(lab, page):
    page.locator(".gsnb-splat-scene").scroll_into_view_if_needed()
    lab.wait_for(lambda: splat_pixels(page).std() > 20, "the map")
    photo = splat_pixels(page)
    for place in ("above", "inside", "photo"):
        page.locator(".gsnb-splat-places button", has_text=place).click()
        lab.wait_for(
            lambda place=place: lab.value(page, f"splats.pose == splats.places['{place}'][0]"),
            "the pose",
        )
        time.sleep(1.0)  # a fine picture
        painted = np.array(lab.value(page, "splats.picture().tolist()"))
        assert np.abs(splat_pixels(page) - painted).mean() < 8, place
        lab.screenshot(page.locator(".gsnb-splat-root").first, f"splats_{place}")
        assert (lab.value(page, "splats.cut_m") > 0) == (place == "above")
    assert np.abs(splat_pixels(page) - photo).mean() < 1
    assert lab.errors == []


@pytest.mark.parametrize(
    ("panel", "slider"),
    [("points", "turn_deg"), ("fill", "heading_deg"), ("fill", "height_m")],
)
def test_sliders_redraw(lab, page, panel, slider):
    image = page.locator(f".gsnb-{panel}-image img").first
    if panel == "fill":
        page.locator(".gsnb-fill-measure").click()
        lab.wait_for(
            lambda: int(page.locator(".gsnb-fill-frames").inner_text()) > 0, "the measurement"
        )
    image.scroll_into_view_if_needed()
    before = image.get_attribute("src")
    lab.move_slider(page.locator(f".gsnb-{panel}-{slider}").first, 6)
    lab.wait_for(lambda: image.get_attribute("src") != before, f"a new picture of {panel}")
    lab.screenshot(page.locator(f".gsnb-{panel}").first, f"{panel}_{slider}")
    assert lab.errors == []
    assert lab.requests == []
