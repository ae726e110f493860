"""What a live view says after a reload of the page and after a restart of the kernel; what screen
readers are told."""

import pytest

pytestmark = [pytest.mark.ci, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

CELLS = [
    """
import torch
torch.set_num_threads(1)
from gsfusion_nb.compare.bench.scene import random_scene
from gsfusion_nb.types import Camera
from gsfusion_nb.viz import SplatViewer, one_gaussian_panel
""",
    "viewer = SplatViewer(random_scene(400, 160, 120).params, width=160, height=120)\nviewer",
    "panel = one_gaussian_panel(Camera(width=80, height=60, fx=52.0, fy=52.0, cx=40.0, "
    "cy=30.0))\npanel",
]
IDLE = "window.jupyterapp?.shell.currentWidget?.sessionContext?.session?.kernel?.status === 'idle'"
SENTENCE = "Run this cell again."


def test_views_work_after_a_reload_and_say_what_to_do_after_a_restart(lab):
    page = lab.open(CELLS)
    sliders = page.locator(".gsnb-one-gaussian .noUi-handle")
    sliders.first.wait_for(timeout=60_000)
    lab.wait_for(
        lambda: all(sliders.nth(k).get_attribute("aria-label") for k in range(7)),
        "the names of the sliders",
    )
    page.evaluate("window.jupyterapp.commands.execute('docmanager:save')")
    lab.wait_for(
        lambda: page.evaluate("!window.jupyterapp.shell.currentWidget.context.model.dirty"),
        "the file",
    )
    page.reload()
    lab.wait_for(lambda: page.evaluate(IDLE), "the kernel after the reload")
    page.locator(".gsnb-one-gaussian-image img").wait_for(timeout=60_000)
    lab.move_slider(page.locator(".gsnb-one-gaussian-z_m"), 2)
    lab.wait_for(
        lambda: lab.value(page, "panel.values['z_m']") == 1.7, "the slider after the reload"
    )
    page.evaluate("window.jupyterapp.shell.currentWidget.sessionContext.session.kernel.restart()")
    for name in (".gsnb-one-gaussian .gsnb-lost", ".gsnb-splat-message"):
        place = page.locator(name).first
        lab.wait_for(lambda place=place: SENTENCE in place.inner_text(), f"the sentence in {name}")
    lab.screenshot(page.locator(".gsnb-one-gaussian").first, "lost_kernel")
    assert lab.errors == []
    page.close()


REOPENED = [
    CELLS[0],
    *CELLS[1:],
    """
from gsfusion_nb.course import predict
predict("reopened", "Which side?", ["left", "right"])
""",
    """
from gsfusion_nb.viz import compositing_stepper
scene = random_scene(40, 64, 48)
compositing_stepper(scene.params, scene.camera, scene.T_WC, (32, 24))
""",
]


@pytest.mark.slow
def test_what_was_stored_is_shown_when_a_notebook_is_opened_again(lab):
    page = lab.open(REOPENED)
    page.locator(".gsnb-one-gaussian-image img").wait_for(timeout=60_000)
    stored = page.locator(".gsnb-stored")
    lab.wait_for(
        lambda: stored.count() == 4 and not any(s.is_visible() for s in stored.all()),
        "nothing stored is seen",
    )
    lab.screenshot(page.locator(".jp-Notebook"), "reopened_0_live")
    page.get_by_role("button", name="left").click()
    page.get_by_text("You predicted left.").first.wait_for()
    page.evaluate("window.jupyterapp.commands.execute('docmanager:save')")
    lab.wait_for(
        lambda: page.evaluate("!window.jupyterapp.shell.currentWidget.context.model.dirty"),
        "the file",
    )
    page.evaluate("window.jupyterapp.shell.currentWidget.sessionContext.shutdown()")
    page.reload()
    lab.wait_for(lambda: page.evaluate(IDLE), "the new kernel")
    lab.wait_for(
        lambda: stored.count() == 4 and all(s.is_visible() for s in stored.all()),
        "what was stored",
    )
    page.wait_for_timeout(4000)  # JupyterLab looks for lost models for two seconds
    assert all(s.is_visible() for s in stored.all())
    assert not page.get_by_text("Error displaying widget").first.is_visible()
    assert stored.get_by_text("You predicted left.").is_visible()
    for picture in stored.locator("img").all():
        assert picture.evaluate("i => i.naturalWidth") > 100
    lab.screenshot(page.locator(".jp-Notebook"), "reopened_1_stored")
    lab.errors.clear()
    page.close()
