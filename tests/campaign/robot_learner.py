"""A robot plays a learner in JupyterLab, and the course's clock is compared with the robot's own watch.

``python tests/campaign/robot_learner.py OUT`` opens chapter 0, unsolved and in its quick version, in Chromium, runs its
cells one by one, waits before some as if it read, and types each solution at the rate of the keystroke-level model
(0.28 s a character), the first one wrong. OUT gets the course file, which says that a robot made it, and the table of
times. These are no learner's times: ``gsfusion-nb course times`` refuses to put them into a syllabus.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from playwright.sync_api import sync_playwright  # noqa: E402

from gsfusion_nb.teaching.edition import learner_copy  # noqa: E402
from tests.browser import conftest as browser  # noqa: E402

KEY_S = 0.28
CHUNK = 6
"""Characters typed at once: shorter pieces would make the editor close brackets by itself."""
READING_S = 12.0
"""Before each cell of an exercise."""
TOLERANCE_S = 8.0
"""Between the clock and the robot's watch: actions within two seconds are noted together; a busy machine is slow."""
QUICK = 'SMOKE = os.environ.get("GSNB_SMOKE", "0") == "1"'
BETWEEN = re.compile(r"### BEGIN SOLUTION\n(.*?)### END SOLUTION", re.DOTALL)

_SELECT = """index => {
    const notebook = window.jupyterapp.shell.currentWidget.content;
    notebook.activeCellIndex = index;
    notebook.activeCell.node.scrollIntoView();
}"""
_RAN = """index => {
    const cell = window.jupyterapp.shell.currentWidget.content.model.cells.get(index);
    return cell.executionCount !== null && cell.executionState !== "running";
}"""
_FORGET = "index => { window.jupyterapp.shell.currentWidget.content.model.cells.get(index).executionCount = null; }"


class Robot:
    """One page, and a watch for each exercise."""

    def __init__(self, page, sources):
        self.page, self.sources, self.last = page, sources, time.monotonic()
        self.watch: dict[str, float] = {}

    def run(self, index, exercise="", *, accepted=False):
        """Run a cell. The time since the last one ended is that of the exercise, and so is that of the cell itself,
        unless the checker accepts a function in it."""
        self.page.evaluate(_SELECT, index)
        self.page.evaluate(_FORGET, index)
        if exercise:
            self.watch[exercise] = self.watch.get(exercise, 0.0) + time.monotonic() - self.last
        started = time.monotonic()
        self.page.evaluate("window.jupyterapp.commands.execute('notebook:run-cell')")
        until = time.monotonic() + 300
        while not self.page.evaluate(_RAN, index):
            if time.monotonic() > until:
                raise TimeoutError(f"cell {index} did not end: {self.sources[index][:200]}")
            time.sleep(0.05)
        if exercise and not accepted:
            self.watch[exercise] += time.monotonic() - started
        self.last = time.monotonic()

    def type(self, index, text):
        """Replace the source of a cell, character by character as far as the editor allows."""
        self.page.evaluate(_SELECT, index)
        self.page.locator(".jp-Notebook .jp-Cell").nth(index).locator(".cm-content").first.click()
        self.page.keyboard.press("Control+a")
        for at in range(0, len(text), CHUNK):
            piece = text[at : at + CHUNK]
            if at + CHUNK > len(text) - 2:
                piece = text[at:]
            time.sleep(KEY_S * len(piece))
            self.page.keyboard.insert_text(piece)
            if piece == text[at:]:
                break


def play(robot, solutions):
    """Every cell from the top; each exercise is read and typed, the first one wrong at first."""
    wrong = True
    for index, source in enumerate(robot.sources):
        if source is None:
            continue
        defined = [name for name in solutions if f"def {name}(" in source]
        checked = re.findall(r"^check\.(\w+)\(\1\)$", source, re.MULTILINE)
        if defined:
            (name,) = defined
            time.sleep(READING_S)
            first = solutions[name].replace("return ", "return 2 * ", 1) if wrong else solutions[name]
            robot.type(index, first)
            robot.run(index, name)
        elif checked:
            robot.run(index, checked[0], accepted=not wrong)
            if wrong:
                wrong = False
                at = next(i for i in range(index) if f"def {checked[0]}(" in (robot.sources[i] or ""))
                time.sleep(READING_S)
                robot.type(at, solutions[checked[0]])
                robot.run(at, checked[0])
                robot.run(index, checked[0], accepted=True)
        else:
            robot.run(index)


def main():
    parser = argparse.ArgumentParser(description="A robot plays a learner; its watch checks the course's clock.")
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=False)
    course = out.resolve() / "course.json"
    os.environ["GSNB_COURSE_FILE"] = str(course)
    course.write_text(json.dumps({"format": 1, "times": {"clock": {"robot": True}}}))

    import nbformat

    solved = json.loads((ROOT / "notebooks/00_quickstart.ipynb").read_text(encoding="utf-8"))
    written = [s for cell in solved["cells"] for s in BETWEEN.findall("".join(cell["source"]))]
    solutions = {name: s.rstrip() for s in written for name in re.findall(r"^def (\w+)\(", s, re.MULTILINE)}
    notebook = nbformat.reads(json.dumps(learner_copy(solved)).replace(json.dumps(QUICK)[1:-1], "SMOKE = True"), 4)
    with browser._server(out / "lab") as (port, token), sync_playwright() as p:
        nbformat.write(notebook, out / "lab" / "work" / "chapter.ipynb")
        chromium = p.chromium.launch(executable_path="/usr/bin/chromium", args=browser._CHROMIUM_OPTIONS)
        page = chromium.new_page(viewport={"width": 1280, "height": 1000})
        page.set_default_timeout(300_000)
        page.goto(f"http://127.0.0.1:{port}/lab/tree/chapter.ipynb?reset&token={token}")
        browser.wait(page, browser._IDLE, 300, "the kernel to be idle")
        sources = [cell.source if cell.cell_type == "code" else None for cell in notebook.cells]
        robot = Robot(page, sources)
        play(robot, solutions)
        page.screenshot(path=str(out / "page.png"))
        chromium.close()
    noted = json.loads(course.read_text())
    off = []
    for name, watched in robot.watch.items():
        clock = noted["times"].get(name, {}).get("seconds", 0.0)
        off.append(abs(clock - watched))
        print(f"{name:16} the course's clock {clock:6.1f} s, the robot's {watched:6.1f} s, {noted['exercises'][name]}")
    table = subprocess.run(
        [sys.executable, "-m", "gsfusion_nb", "course", "times", str(course)],
        capture_output=True,
        text=True,
        check=True,
    )
    (out / "times.txt").write_text(table.stdout)
    print(table.stdout[:700])
    print(f"largest difference {max(off):.1f} s: {'agreed' if max(off) <= TOLERANCE_S else 'NOT AGREED'}")
    return 0 if max(off) <= TOLERANCE_S else 1


if __name__ == "__main__":
    sys.exit(main())
