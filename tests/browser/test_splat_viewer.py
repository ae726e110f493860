"""The splat viewer as a person uses it: JupyterLab, Chromium, a mouse."""

import base64
import time

import cv2
import numpy as np
import pytest

pytestmark = [pytest.mark.ci, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

MAP = """
import torch
torch.set_num_threads(1)
from gsfusion_nb.config import gsfusion
from gsfusion_nb.data import open_sequence
from gsfusion_nb.mapping import GSFusion
from gsfusion_nb.runs import MappingRun
config = gsfusion("room", optim__global_iterations=0)
run = MappingRun(open_sequence("room", data=config.data, n_frames=8), GSFusion(config))
steps = run.online()
for _ in range(3):
    next(steps)
"""
VIEW = """
from gsfusion_nb.viz import SplatViewer
viewer = SplatViewer(run.mapper, width=320, height=240)
heard = []
viewer.observe(lambda change: heard.append(change["new"]), "picked")
viewer
"""


class Scene:
    """The viewer on the page, and the kernel behind it."""

    def __init__(self, lab, page):
        self.lab = lab
        self.page = page
        self.element = page.locator(".gsnb-splat-scene")
        self.element.scroll_into_view_if_needed()
        self.lab.wait_for(
            lambda: self.value("viewer.stats.get('pictures', 0)") > 0, "the first picture"
        )

    def value(self, expression):
        return self.lab.value(self.page, expression)

    def pixels(self, layer="software"):
        """Bytes of a canvas. [H, W, 3]"""
        script = f"document.querySelector('.gsnb-splat-{layer}').toDataURL('image/png')"
        png = base64.b64decode(self.page.evaluate(script).split(",")[1])
        image = np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR))
        return image[..., ::-1].copy()

    def settle(self):
        """Until the picture is refined and two looks at it agree."""
        last = self.pixels()
        for _ in range(100):
            time.sleep(0.25)
            now = self.pixels()
            if (now == last).all():
                return now
            last = now
        raise AssertionError("the picture does not come to rest")

    def spot(self, x, y):
        box = self.element.bounding_box()
        return box["x"] + x * box["width"], box["y"] + y * box["height"]

    def drag(self, dx, dy, key=None):
        x, y = self.spot(0.5, 0.5)
        self.page.mouse.move(x, y)
        if key:
            self.page.keyboard.down(key)
        self.page.mouse.down()
        for k in range(1, 13):
            self.page.mouse.move(x + dx * k / 12, y + dy * k / 12)
        self.page.mouse.up()
        if key:
            self.page.keyboard.up(key)
        return self.settle()

    def screenshot(self, name):
        self.lab.screenshot(self.page.locator(".gsnb-splat-root"), name)


@pytest.fixture(scope="module")
def scene(lab):
    page = lab.open([MAP, VIEW])
    yield Scene(lab, page)
    page.close()


def difference(a, b):
    return np.abs(a.astype(int) - b).mean()


def psnr(a, b):
    return 10 * np.log10(255**2 / ((a.astype(float) - b) ** 2).mean())


@pytest.fixture
def start(scene):
    """Every test begins at the first pose with the first settings; the picture there."""
    code = "viewer.set_trait('pose', viewer.places['photo'][0])"
    for name, value in (
        ("colour_by", "rgb"),
        ("points", False),
        ("born_until", None),
        ("renderer", "software"),
        ("picked", None),
    ):
        code += f"; viewer.{name} = {value!r}"
    scene.lab.run(scene.page, code)
    return scene.settle()


def test_it_shows_what_our_renderer_shows(scene, start):
    ours = np.array(scene.value("viewer.picture().tolist()"), np.uint8)
    scene.screenshot("start")
    assert start.std() > 20
    assert psnr(start, ours) > 40  # upright and not mirrored; 55 dB seen


def test_dragging_orbits_and_r_goes_back(scene, start):
    turned = scene.drag(90, 20)
    scene.screenshot("orbit")
    assert difference(turned, start) > 5
    assert scene.value("viewer.pose") != scene.value("viewer.places['photo'][0]")
    ours = np.array(scene.value("viewer.picture().tolist()"), np.uint8)
    assert psnr(turned, ours) > 38
    scene.page.keyboard.press("r")  # the notebook would make the cell raw
    assert difference(scene.settle(), start) < 0.5
    assert scene.value("viewer.pose") == pytest.approx(
        scene.value("viewer.places['photo'][0]"), abs=1e-5
    )


def test_pan_zoom_and_arrows(scene, start):
    panned = scene.drag(60, 0, key="Shift")
    assert difference(panned, start) > 5
    scene.page.keyboard.press("Home")
    scene.settle()
    scene.page.mouse.wheel(0, -300)
    zoomed = scene.settle()
    assert difference(zoomed, start) > 3
    scene.page.keyboard.press("ArrowLeft")
    assert difference(scene.settle(), zoomed) > 2


def test_a_click_arrives_in_python(scene, start):
    scene.page.mouse.click(*scene.spot(0.5, 0.6))
    scene.lab.wait_for(lambda: scene.value("viewer.picked") is not None, "the pick")
    row = scene.value("viewer.picked")
    scene.settle()
    scene.screenshot("picked")
    assert scene.value("heard")[-1] == row
    assert scene.value("viewer.picked_row().row") == row
    T = np.array(scene.value("viewer.places['photo'][0]")).reshape(4, 4)
    x, y, z = T[:3, :3].T @ (np.array(scene.value("viewer.picked_row().xyz_W")) - T[:3, 3])
    fx, fy, cx, cy = scene.value("viewer.intrinsics")
    reach = 4 * max(scene.value("viewer.picked_row().scale_m")) / z * fx + 3
    assert np.hypot(fx * x / z + cx - 160, fy * y / z + cy - 144) < reach


def test_colours_and_legend(scene, start):
    seen = [start]
    for name in ("depth", "tag", "birth_frame", "opacity"):
        scene.page.locator(".gsnb-splat-colour_by").select_option(name)
        scene.lab.wait_for(lambda name=name: scene.value("viewer.colour_by") == name, "the choice")
        seen.append(scene.settle())
        scene.screenshot(f"colour_{name}")
        assert difference(seen[-1], seen[-2]) > 5
        assert scene.page.locator(".gsnb-splat-legend").inner_text()
    scene.page.locator(".gsnb-splat-colour_by").select_option("rgb")
    assert difference(scene.settle(), start) < 0.5
    scene.page.locator(".gsnb-splat-points").check()
    assert difference(scene.settle(), start) > 20
    scene.screenshot("points")
    scene.page.locator(".gsnb-splat-points").uncheck()


def test_the_time_slider_hides_what_came_later(scene, start):
    first = int(scene.value("viewer.birth_range")[0])
    scene.page.locator(".gsnb-splat-time").fill(str(first))
    scene.lab.wait_for(lambda: scene.value("viewer.born_until") == first, "the slider")
    early = scene.settle()
    scene.screenshot("time")
    hidden = difference(early, start)
    assert hidden > 0.15
    ours = np.array(scene.value("viewer.picture().tolist()"), np.uint8)
    assert psnr(early, ours) > 38
    scene.page.locator(".gsnb-splat-play").click()
    scene.lab.wait_for(lambda: scene.value("viewer.born_until") is None, "the end of the film")
    assert difference(scene.settle(), start) < 0.2 * hidden


def test_it_follows_a_growing_map(scene, start):
    n = scene.value("len(run.mapper.gaussians)")
    scene.drag(60, 0)
    before = scene.settle()
    scene.lab.run(scene.page, "for _ in range(4): next(steps); viewer.update()")
    assert scene.value("len(run.mapper.gaussians)") > n
    scene.lab.wait_for(lambda: difference(scene.pixels(), before) > 0.3, "the new Gaussians")
    after = scene.settle()
    ours = np.array(scene.value("viewer.picture().tolist()"), np.uint8)
    assert psnr(after, ours) > 38


def test_webgl_shows_the_same_when_asked_for(scene, start):
    if not scene.page.evaluate("Boolean(document.createElement('canvas').getContext('webgl2'))"):
        pytest.skip("this Chromium has no WebGL2")
    scene.page.locator(".gsnb-splat-renderer").select_option("webgl")
    scene.lab.wait_for(lambda: scene.value("viewer.renderer_used") == "webgl", "the switch")
    software = scene.pixels()
    # it blends in 8 bits
    scene.lab.wait_for(lambda: psnr(scene.pixels("gpu"), software) > 32, "the same picture")
    scene.screenshot("webgl")
    scene.page.locator(".gsnb-splat-renderer").select_option("auto")
    scene.lab.wait_for(
        lambda: scene.value("viewer.renderer_used") == "software" or scene.value("viewer.gpu"),
        "the switch",
    )


def test_nothing_broke_and_nothing_came_from_elsewhere(scene):
    assert scene.lab.errors == []
    assert scene.lab.requests == []
