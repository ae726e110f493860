"""``PYTHONPATH=tools python -m book.posters`` draws what the panels show before their scripts run.

It opens each panel in Chromium and stores its pictures and graphs in ``live/posters``. It is needed
after a change of a panel's first picture, and needs the extra ``browser``.
"""

import base64
import shutil
import sys
import tempfile
from pathlib import Path

from .live_panels import PANELS, POSTERS, common_script, panel_html, panel_script

_STEPS = 150
"""Of the painting, so that its poster shows a picture."""
_READY = "document.querySelector('[data-picture] canvas')"
_WEBP = "canvas => canvas.toDataURL('image/webp', 0.6).split(',')[1]"


def write_posters(names: list[str], target: Path = POSTERS) -> None:
    """Draw the posters of some panels.

    Args:
        names: Panels.
        target: Folder of the posters; files of the same name are replaced.

    Raises:
        RuntimeError: no Chromium is installed.
    """
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise RuntimeError("no chromium here (Debian: apt-get install chromium)")
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=chromium, args=["--no-sandbox", "--disable-gpu"]
        )
        for name in names:
            page = browser.new_page(reduced_motion="reduce")
            page.goto(f"file://{_panel_page(name, Path(folder))}")
            page.wait_for_function(_READY)
            for _ in range(_STEPS if name == "paint" else 0):
                page.locator("button[name=step]").click()
            for stage in page.locator("[data-picture]").all():
                picture = base64.b64decode(stage.locator("canvas").evaluate(_WEBP))
                file = target / f"{name}_{stage.get_attribute('data-picture')}.webp"
                file.write_bytes(picture)
            for chart in page.locator("[data-chart]").all():
                file = target / f"{name}_{chart.get_attribute('data-chart')}.html"
                file.write_text(chart.inner_html().strip() + "\n", encoding="utf-8")
            page.close()
        browser.close()


def _panel_page(name: str, folder: Path) -> Path:
    """A page with one panel and nothing else; its path."""
    static = folder / "_static"
    static.mkdir(exist_ok=True)
    (static / "live_panels.js").write_text(common_script(), encoding="utf-8")
    (static / f"live_{name}.js").write_text(panel_script(name), encoding="utf-8")
    page = folder / f"{name}.html"
    panel = panel_html(name, "", first=True)
    page.write_text(f"<!doctype html><meta charset=utf-8>{panel}", encoding="utf-8")
    return page


if __name__ == "__main__":
    write_posters(sys.argv[1:] or sorted(set(PANELS.values())))
