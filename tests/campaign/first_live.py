"""How soon a page of the web book shows its first live picture on a slow computer.

    python tests/campaign/first_live.py runs/book notebooks/02_tsdf_fusion notebooks/04_splatting_forward

Chromium opens each page with its processor slowed down (DevTools' CPU throttling). Printed: processor time of the
page's main thread until the picture, which other programs do not change, and the time on the clock, which they do;
seconds, the smallest of three.
"""

import argparse
import shutil
import time
from pathlib import Path

from playwright.sync_api import Browser, sync_playwright

RATES = (1, 4, 6)
TIMES = 3
SHOW = """() => {
    for (const came of document.querySelectorAll(".gsnb-came")) Object.assign(came.style, { display: "block" });
    const views = [...document.querySelectorAll(".gsnb-view")];
    views.find((view) => view.dataset.bytes < 1200000 && view.offsetParent).scrollIntoView();
}"""
THERE = """() => {
    const stage = document.querySelector(".gsnb-view[data-state=live] .gsnb-view-stage");
    const picture = stage?.querySelector("img");
    return picture ? picture.complete && picture.naturalWidth > 0 : Boolean(stage?.querySelector("canvas"));
}"""


def first_picture(browser: Browser, address: str, rate: int) -> tuple[float, float]:
    """Processor time of the main thread and time on the clock until the first picture, seconds."""
    context = browser.new_context()
    page = context.new_page()
    devtools = context.new_cdp_session(page)
    devtools.send("Performance.enable", {"timeDomain": "threadTicks"})
    devtools.send("Emulation.setCPUThrottlingRate", {"rate": rate})
    began = time.perf_counter()
    page.goto(address, wait_until="domcontentloaded", timeout=120_000)
    page.evaluate(SHOW)
    page.wait_for_function(THERE, polling=50, timeout=120_000)
    seconds = time.perf_counter() - began
    metrics = {one["name"]: one["value"] for one in devtools.send("Performance.getMetrics")["metrics"]}
    context.close()
    return metrics["TaskDuration"], seconds


def main() -> None:
    """Measure each page at each rate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("book", type=Path)
    parser.add_argument("pages", nargs="+")
    options = parser.parse_args()
    with sync_playwright() as playwright:
        chromium = shutil.which("chromium")
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        for page in options.pages:
            for rate in RATES:
                address = f"file://{options.book.resolve()}/{page}.html"
                used, clock = zip(*(first_picture(browser, address, rate) for _ in range(TIMES)), strict=True)
                print(f"{page}, {rate} times slower: {min(used):.1f} s of processor, {min(clock):.1f} s on the clock")
        browser.close()


if __name__ == "__main__":
    main()
