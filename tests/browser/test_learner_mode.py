"""What a learner meets in JupyterLab: whose code runs, a prediction, a live view with its slider,
links to source."""

import pytest

pytestmark = pytest.mark.ci

CELLS = [
    """
from gsfusion_nb.geometry import project
from gsfusion_nb.course import came, check, course_progress, predict
from gsfusion_nb.course.source_lines import source_lines
course_progress(0)
""",
    'predict("browser_seeds", "How many Gaussians will the first frame give?", [300, 3000, 30000])',
    """\
def psnr(rendered, photo):
    noise = (rendered - photo).square().mean()
    return noise.decibels()
mark = check.psnr.working(psnr)
check.psnr(psnr)
""",
    """
from gsfusion_nb import GSFusion, gsfusion, open_sequence
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.viz import LiveMapper
config = gsfusion("room", data__stop=6, data__width=96, data__height=72, tsdf__voxel_size_m=0.04)
run = MappingRun(open_sequence("room", data=config.data, n_frames=60), GSFusion(config))
live = LiveMapper(run)
live.run_sync(1)
live
""",
    "live.run_sync()",
    'source_lines({"Eq. 4, u": (project, "u = camera.fx * xyz_C")})',
]

LINE = """(() => {
    const editor = window.jupyterapp.shell.currentWidget?.content?.editor;
    return editor ? editor.getLine(editor.getCursorPosition().line) : "";
})()"""


@pytest.fixture(scope="module")
def page(project_lab):
    return project_lab.open(CELLS, timeout_s=400)


def test_the_notebook_says_whose_code_is_used_and_names_the_line(project_lab, page):
    said = page.locator(".gsnb-whose").first
    assert "the reference's is used: yours fails" in said.inner_text()
    assert "line 3 of cell 3, `return noise.decibels()`" in said.inner_text()
    project_lab.screenshot(page.locator(".jp-Cell").nth(2), "whose_code")
    assert "This chapter: 0 of 3 exercises solved" in page.locator(".gsnb-course").inner_text()


def test_a_prediction_is_recorded_by_a_click(project_lab, page):
    page.locator(".gsnb-prediction-answer button", has_text="3,000").first.click()
    project_lab.wait_for(
        lambda: "You predicted 3,000" in page.locator(".gsnb-prediction").first.inner_text(),
        "the answer",
        60,
    )
    project_lab.screenshot(page.locator(".jp-Cell").nth(1), "prediction")
    shown = project_lab.run(page, 'print(came("browser_seeds", 2890))')
    assert shown == "You predicted 3,000. It came: 2,890. Close."


def test_the_live_view_is_finished_and_its_slider_goes_back(project_lab, page):
    assert page.locator(".gsnb-live button:enabled").count() == 0
    slider = page.locator(".gsnb-live-back")
    before = project_lab.value(page, "live.scrubber.widget.value")
    project_lab.screenshot(page.locator(".gsnb-live").first, "live_finished")
    project_lab.move_slider(slider, -before)
    status = page.locator(".gsnb-live-status")
    project_lab.wait_for(
        lambda: "looking back at frame 0" in status.inner_text(), "the first frame", 60
    )
    project_lab.screenshot(page.locator(".gsnb-live").first, "live_looking_back")


def test_a_click_opens_the_file_at_the_line(project_lab, page):
    link = page.locator(".jp-OutputArea-output a").first
    assert link.inner_text().startswith("geometry/camera.py:")
    link.click()
    project_lab.wait_for(
        lambda: "u = camera.fx * xyz_C" in page.evaluate(LINE), "the editor at the line", 60
    )
    project_lab.screenshot(page.locator(".jp-FileEditor"), "source_link")
    assert project_lab.errors == []
