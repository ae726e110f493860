"""The finished maps as a person looks at them: a mesh and Gaussians to turn, a volume to fill; without a network."""

import base64
import time

import cv2
import numpy as np
import pytest

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

MAP = """
import torch
torch.set_num_threads(1)
from gsfusion_nb import GSFusion, gsfusion, open_sequence
from gsfusion_nb.viz import SplatViewer, tsdf_fill_panel, point_panel, show_mesh
config = gsfusion("room", tsdf__voxel_size_m=0.02)
walk = open_sequence("room", data=config.data, n_frames=60)
mapper = GSFusion(config)
for i in range(6):
    mapper.step(walk.mapping[i])
"""
MESH = """
viewer = show_mesh(mapper.mesh(), size=(480, 360))
viewer
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
fill = tsdf_fill_panel(TsdfVolume(TsdfConfig(voxel_size_m=0.04)), camera, lambda T_WC: walk.mapping[0])
fill
"""


@pytest.fixture(scope="module")
def page(lab):
    page = lab.open([MAP, MESH, SPLATS, POINTS, FILL])
    yield page
    page.close()


def mesh_pixels(page):
    """Bytes of the mesh viewer's canvas. [H, W, 3]"""
    url = page.evaluate("document.querySelector('.gsnb-mesh-scene canvas').toDataURL('image/png')")
    png = np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8)
    return np.asarray(cv2.imdecode(png, cv2.IMREAD_COLOR))[..., ::-1].astype(int)


def kind(page):
    return page.locator(".gsnb-mesh-scene").get_attribute("data-picture")


def settled(page):
    """The fine picture, when the camera is at rest."""
    last = mesh_pixels(page)
    for _ in range(100):
        time.sleep(0.3)
        now = mesh_pixels(page)
        if (now == last).all() and kind(page) == "fine":
            return now
        last = now
    raise AssertionError("the picture does not come to rest")


def test_a_mesh_is_turned_offline(lab, page):
    scene = page.locator(".gsnb-mesh-scene")
    scene.scroll_into_view_if_needed()
    lab.wait_for(lambda: lab.value(page, "viewer.stats.get('pictures', 0)") > 0, "the first picture")
    before = settled(page)
    painted = np.array(lab.value(page, "viewer.picture().tolist()"))
    assert before.std() > 20
    assert np.abs(before - painted).mean() < 8  # the same view, upright and not mirrored
    assert np.abs(before - painted[:, ::-1]).mean() > 12
    lab.screenshot(page.locator(".gsnb-mesh-scene").first, "mesh")

    box = scene.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 120, y + 20, steps=12)
    for _ in range(10):  # the button is down and nothing moves: longer than a fine picture would wait and take
        time.sleep(0.1)
        assert kind(page) == "coarse"
    page.mouse.up()
    turned = settled(page)
    assert np.abs(turned - before).mean() > 5
    lab.wait_for(lambda: lab.value(page, "viewer.pose != viewer.home"), "the pose in Python")
    painted = np.array(lab.value(page, "viewer.picture().tolist()"))
    assert np.abs(turned - painted).mean() < 8
    lab.screenshot(page.locator(".gsnb-mesh-scene").first, "mesh_turned")

    page.mouse.wheel(0, -300)  # the scene has the focus since the click
    zoomed = settled(page)
    assert np.abs(zoomed - turned).mean() > 2
    page.mouse.dblclick(x, y)
    page.keyboard.press("ArrowLeft")
    assert np.abs(settled(page) - zoomed).mean() > 1
    lab.run(page, "viewer.shading = 'shape'")
    lab.wait_for(lambda: np.ptp(mesh_pixels(page), axis=-1).max() <= 4, "a grey surface")
    lab.run(page, "viewer.shading = 'colour'")
    page.keyboard.press("r")
    assert np.abs(settled(page) - before).mean() < 0.5
    outputs = page.locator(".jp-OutputArea").all_inner_texts()
    assert not any("Traceback" in text or "Error" in text for text in outputs)
    assert lab.errors == []
    assert lab.requests == []


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
        lab.wait_for(lambda place=place: lab.value(page, f"splats.pose == splats.places['{place}'][0]"), "the pose")
        time.sleep(1.0)  # a fine picture
        painted = np.array(lab.value(page, "splats.picture().tolist()"))
        assert np.abs(splat_pixels(page) - painted).mean() < 8, place
        lab.screenshot(page.locator(".gsnb-splat-root").first, f"splats_{place}")
        assert (lab.value(page, "splats.cut_m") > 0) == (place == "above")
    assert np.abs(splat_pixels(page) - photo).mean() < 1
    assert lab.errors == []


@pytest.mark.parametrize(("panel", "slider"), [("points", "turn_deg"), ("fill", "heading_deg"), ("fill", "height_m")])
def test_sliders_redraw(lab, page, panel, slider):
    image = page.locator(f".gsnb-{panel}-image img").first
    if panel == "fill":
        page.locator(".gsnb-fill-measure").click()
        lab.wait_for(lambda: int(page.locator(".gsnb-fill-frames").inner_text()) > 0, "the measurement")
    image.scroll_into_view_if_needed()
    before = image.get_attribute("src")
    lab.move_slider(page.locator(f".gsnb-{panel}-{slider}").first, 6)
    lab.wait_for(lambda: image.get_attribute("src") != before, f"a new picture of {panel}")
    lab.screenshot(page.locator(f".gsnb-{panel}").first, f"{panel}_{slider}")
    assert lab.errors == []
    assert lab.requests == []
