"""The panel of a trace as a person uses it: slider, buttons, clicks, keys, both themes, a window of
1000 px."""

import pytest

pytestmark = [pytest.mark.ci, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

MAP = """
import torch
torch.set_num_threads(1)
from gsfusion_nb import GSFusion, gsfusion, open_sequence
from gsfusion_nb.course.trace import Trace
from gsfusion_nb.viz import SplatViewer, TracePanel
config = gsfusion("room", data__width=96, data__height=72, tsdf__voxel_size_m=0.04)
sequence = open_sequence("room", data=config.data, n_frames=16)
mapper = GSFusion(config)
trace = Trace(mapper)
for i in range(3):
    mapper.step(sequence.mapping[i])
panel = TracePanel(trace, gaussian=1)
panel
"""


def test_the_panel_follows_a_gaussian_and_a_voxel(lab):
    page = lab.open([MAP])
    page.set_viewport_size({"width": 1000, "height": 1000})
    page.evaluate("window.jupyterapp.shell.collapseLeft()")
    root = page.locator(".gsnb-trace").first
    image = page.locator("img.gsnb-click-image").first
    box = root.bounding_box()
    assert box["x"] + box["width"] <= 1000
    lab.screenshot(root, "trace_seeded")
    last = lab.value(page, "panel.controls['moment'].max")
    lab.move_slider(page.locator(".gsnb-trace-moment"), 3)
    lab.wait_for(lambda: lab.value(page, "panel.moment") == 3, "the slider")
    lab.screenshot(root, "trace_step")
    page.locator(".gsnb-trace-previous").click()
    lab.wait_for(lambda: lab.value(page, "panel.moment") == 2, "the button")
    image.click(position={"x": 150, "y": 120})
    lab.wait_for(lambda: lab.value(page, "panel.story.row") != 1, "another Gaussian")
    assert "Gaussian" in image.get_attribute("alt")
    lab.screenshot(root, "trace_gaussian")
    page.locator(".gsnb-trace-follows select").select_option("voxel")
    lab.wait_for(lambda: lab.value(page, "panel.values['follows']") == "voxel", "the choice")
    image.focus()
    page.keyboard.press("ArrowRight")
    lab.wait_for(lambda: lab.value(page, "hasattr(panel.story, 'ijk')"), "a voxel")
    page.evaluate(
        "window.jupyterapp.commands.execute('apputils:change-theme', {theme: 'JupyterLab Dark'})"
    )
    page.wait_for_selector("body[data-jp-theme-light=false]", state="attached")
    lab.screenshot(root, "trace_voxel_dark")
    lab.run(
        page,
        "viewer = SplatViewer(mapper, width=96, height=72); panel.follow_picks(viewer); "
        "viewer.picked = 7",
    )
    assert lab.value(page, "panel.story.row") == 7
    lab.screenshot(root, "trace_picked_dark")
    assert last > 3
    assert lab.errors == []
