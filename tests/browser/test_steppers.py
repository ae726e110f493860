"""A stepper as a person uses it: Next, Back, Restart, arrow keys, the slider, both themes, a window
of 1000 px."""

import pytest

pytestmark = [pytest.mark.ci, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

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

OTHERS = {
    "quadtree": "quadtree_stepper(frame.rgb_u8[:48, :64], threshold=0.05, min_cell_px=2)",
    "compositing": "compositing_stepper(four.params, view, torch.eye(4), (8, 6))",
    "compositing_gradient": "compositing_gradient_stepper(four.params, view, torch.eye(4), (8, 6), "
    "torch.ones(3) / 2)",
    "adam": 'adam_stepper(adam_steps="shared", earlier_steps=20)',
    "icp": "icp_stepper(frame.depth_m, frame.camera, known, displaced_pose(frame.T_WC, 0.05, 0.0))",
    "pose_graph": "pose_graph_stepper(torch.stack([torch.linalg.matrix_power(bent, k) for k in "
    "range(4)]), ring)",
}
"""Name -> the call that makes it."""
SETTING = """
import torch
torch.set_num_threads(1)
from gsfusion_nb.data.room import RoomSequence
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking import Edge, odometry_information
from gsfusion_nb.types import Camera, Seeds
from gsfusion_nb.viz import (
    adam_stepper,
    compositing_gradient_stepper,
    compositing_stepper,
    displaced_pose,
    frame_surface,
    icp_stepper,
    pose_graph_stepper,
    quadtree_stepper,
)
sequence = RoomSequence(n_frames=480, width=80, height=60)
frame, known = sequence[2], frame_surface(sequence[0])
four = GaussianModel(sh_degree=0)
places = torch.tensor([[0.0, 0.0, 1.0 + 0.1 * k] for k in range(4)])
four.append(Seeds.isotropic(places, torch.rand(4, 3), torch.full((4,), 0.2), opacity=0.5))
view = Camera(width=16, height=12, fx=14.0, fy=14.0, cx=8.0, cy=6.0)
around = se3.exp(torch.tensor([0.9, 0.35, 0.0, 0.0, 0.0, 1.0], dtype=torch.float64))
bent = around @ se3.exp(torch.tensor([0.03, -0.02, 0.0, 0.0, 0.0, 0.03], dtype=torch.float64))
firm = odometry_information(1.0, 0.02)
ring = [Edge(i=k, j=k + 1, T_ij=bent, information=firm, kind="odometry") for k in range(3)]
closing = torch.linalg.matrix_power(around, 3)
ring.append(Edge(i=0, j=3, T_ij=closing, information=firm, kind="loop"))
"""

TIMES = """async () => {
  const root = document.querySelector(".gsnb-stepper-raycast");
  const image = root.querySelector("img");
  const next = root.querySelector(".gsnb-stepper-next");
  const times = [];
  for (let i = 0; i < 12; i++) {
    const began = performance.now();
    const before = image.src;
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
    cubes = page.locator(".gsnb-stepper-marching-cubes-1")
    ray = page.locator(".gsnb-stepper-raycast")
    box = cubes.bounding_box()
    assert box["x"] + box["width"] <= 1000
    lab.screenshot(cubes, "stepper_cubes")
    image = cubes.locator("img")
    alt = cubes.locator("img").get_attribute("alt")
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
    page.evaluate(
        "window.jupyterapp.commands.execute('apputils:change-theme', {theme: 'JupyterLab Dark'})"
    )
    page.wait_for_selector("body[data-jp-theme-light=false]", state="attached")
    lab.screenshot(ray, "stepper_ray_dark")
    assert lab.errors == []


@pytest.mark.slow
def test_every_other_stepper_goes_to_its_end_in_a_page(lab):
    page = lab.open(
        [SETTING, *(f"{name} = {call}\n{name}" for name, call in OTHERS.items())], timeout_s=300
    )
    page.set_viewport_size({"width": 1000, "height": 900})
    page.evaluate("window.jupyterapp.shell.collapseLeft()")
    for name in OTHERS:
        stepper = page.locator(f".gsnb-stepper-{name.replace('_', '-')}")
        stepper.scroll_into_view_if_needed()
        box = stepper.bounding_box()
        image = stepper.locator("img")
        assert box["x"] + box["width"] <= 1000, name
        first = image.get_attribute("src")
        for step in (1, 2):
            stepper.locator(".gsnb-stepper-next").click()
            lab.wait_for(
                lambda n=name, k=step: lab.value(page, f"{n}.step") == k, f"step {step} of {name}"
            )
        assert stepper.locator("mark").count() >= 1, f"no line of code is marked in {name}"
        stepper.focus()
        page.keyboard.press("End")
        lab.wait_for(
            lambda n=name: lab.value(page, f"{n}.step == {n}.count - 1"), f"the end of {name}"
        )
        assert stepper.locator(".gsnb-stepper-next").is_disabled()
        assert image.get_attribute("src") != first, name
        lab.screenshot(stepper, f"stepper_{name}")
    assert lab.errors == []
