"""A stepper as a person uses it: Next, Back, Restart, arrow keys, the slider, both themes, a window of 1000 px."""

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

VOLUME = """
import torch
torch.set_num_threads(1)
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.data.room import RoomSequence
from gsfusion_nb.tsdf import TsdfVolume, integrate
from gsfusion_nb.viz import marching_cubes_stepper, raycast_stepper
sequence = RoomSequence(n_frames=60, width=80, height=60)
volume = TsdfVolume(TsdfConfig(voxel_size_m=0.04))
for i in range(3):
    integrate(volume, sequence[i])
frame = sequence[0]
cubes = marching_cubes_stepper(volume)
cubes
"""
RAY = "ray = raycast_stepper(volume, frame.camera, frame.T_WC, (30, 30))\nray"

TIMES = """async () => {
  const root = document.querySelector(".gsnb-stepper-raycast");
  const image = root.querySelector("img"), next = root.querySelector(".gsnb-stepper-next"), times = [];
  for (let i = 0; i < 12; i++) {
    const began = performance.now(), before = image.src;
    next.click();
    while (image.src === before) await new Promise(requestAnimationFrame);
    await image.decode();
    await new Promise(requestAnimationFrame);
    times.push(performance.now() - began);
  }
  return times.sort((a, b) => a - b)[6];
}"""


def test_next_back_restart_keys_and_slider(lab):
    page = lab.open([VOLUME, RAY])
    page.set_viewport_size({"width": 1000, "height": 900})
    page.evaluate("window.jupyterapp.shell.collapseLeft()")
    cubes, ray = page.locator(".gsnb-stepper-marching-cubes-1"), page.locator(".gsnb-stepper-raycast")
    box = cubes.bounding_box()
    assert box["x"] + box["width"] <= 1000
    lab.screenshot(cubes, "stepper_cubes")
    image, alt = cubes.locator("img"), cubes.locator("img").get_attribute("alt")
    assert cubes.locator(".gsnb-stepper-back").is_disabled()
    cubes.locator(".gsnb-stepper-next").click()
    lab.wait_for(lambda: image.get_attribute("alt") != alt, "the next step")
    assert "step 2 of" in image.get_attribute("alt")
    assert cubes.locator("mark").count() >= 1
    cubes.focus()
    page.keyboard.press("ArrowRight")
    lab.wait_for(lambda: lab.value(page, "cubes.step") == 2, "the arrow key")
    page.keyboard.press("End")
    lab.wait_for(lambda: "The triangles between" in image.get_attribute("alt"), "the last step")
    lab.screenshot(cubes, "stepper_cubes_end")
    cubes.locator(".gsnb-stepper-back").click()
    lab.wait_for(lambda: lab.value(page, "cubes.step == cubes.count - 2"), "the step before")
    cubes.locator(".gsnb-stepper-slider").fill("5")
    lab.wait_for(lambda: lab.value(page, "cubes.step") == 5, "the slider")
    cubes.locator(".gsnb-stepper-restart").click()
    lab.wait_for(lambda: lab.value(page, "cubes.step") == 0, "the first step")
    ray.scroll_into_view_if_needed()
    print(f"from Next to the picture: {page.evaluate(TIMES):.0f} ms")  # noqa: T201
    page.evaluate("window.jupyterapp.commands.execute('apputils:change-theme', {theme: 'JupyterLab Dark'})")
    page.wait_for_selector("body[data-jp-theme-light=false]", state="attached")
    lab.screenshot(ray, "stepper_ray_dark")
    assert lab.errors == []
