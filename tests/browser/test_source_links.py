"""A click on the place of an equation opens the file in JupyterLab at the line."""

import pytest

pytestmark = pytest.mark.slow

CELL = """
from gsfusion_nb.geometry import project
from gsfusion_nb.teaching.source_lines import source_lines
source_lines({"Eq. 4, u": (project, "u = camera.fx * xyz_C")})
"""

LINE = """(() => {
    const editor = window.jupyterapp.shell.currentWidget?.content?.editor;
    return editor ? editor.getLine(editor.getCursorPosition().line) : "";
})()"""


def test_a_click_opens_the_file_at_the_line(project_lab):
    page = project_lab.open([CELL])
    link = page.locator(".jp-OutputArea-output a").first
    assert link.inner_text().startswith("geometry/camera.py:")
    link.click()
    project_lab.wait_for(lambda: "u = camera.fx * xyz_C" in page.evaluate(LINE), "the editor at the line", 60)
    project_lab.screenshot(page.locator(".jp-FileEditor"), "source_link")
    assert "camera.py" in page.title() or page.locator(".lm-TabBar-tabLabel", has_text="camera.py").count() == 1
    assert project_lab.errors == []
