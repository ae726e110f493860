"""The seeding lab as a person uses it: the page of a comparison from a file, and the live table in
a notebook."""

import itertools

import cv2
import numpy as np
import pytest

from gsfusion_nb.compare import Budget, RunResult, RunSpec
from gsfusion_nb.compare.outputs import Results
from gsfusion_nb.compare.run_all import ResultStore

pytestmark = [pytest.mark.ci, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

BUDGETS = (Budget(gaussians=4000), Budget(steps="own"))
PSNR = {"quadtree": 24.8, "uniform": 24.4, "with a <long> name & more": 22.0}
LIVE = """
import torch
torch.set_num_threads(1)
from gsfusion_nb.compare import Budget
from gsfusion_nb.compare.entries import entries_of
from gsfusion_nb.compare.live_table import LiveTable
settings = {
    "data.width": 64,
    "data.height": 48,
    "data.stop": 12,
    "data.hold_out_every": 5,
    "tsdf.voxel_size_m": 0.05,
    "sh_degree": 0,
    "optim.global_iterations": 0,
    "seeding.quadtree_contrast": "std",
    "seeding.quadtree_threshold": 0.05,
}
runs = entries_of(
    ["gsfusion", "uniform"],
    seeds=(0,),
    budgets=(Budget(steps="own"),),
    settings=settings,
    reader={"n_frames": 60},
)
live = LiveTable(runs, "results")
live
"""


def results(folder):
    noise = np.random.default_rng(0)
    found = []
    truth = np.repeat(np.linspace(30, 220, 64)[None, :, None], 48, 0).repeat(3, 2).astype(np.uint8)
    cv2.imwrite(str(folder / "truth.png"), truth)
    for budget, scene, label, seed in itertools.product(
        BUDGETS, ("room", "kitchen"), PSNR, range(3)
    ):
        spec = RunSpec(
            rule="uniform", label=label, scene=scene, data="room", seed=seed, budget=budget
        )
        file = f"{list(PSNR).index(label)}.png"
        sd = 255 * 10 ** (-PSNR[label] / 20)
        cv2.imwrite(
            str(folder / file),
            np.clip(truth + noise.normal(0, sd, truth.shape), 0, 255).astype(np.uint8),
        )
        numbers = {
            "psnr_held_out_db": PSNR[label] + float(noise.normal(0, 0.05)),
            "n_gaussians": 4000.0 + seed,
            "ms_per_frame": 40.0 + 10 * list(PSNR).index(label) + seed,
        }
        pictures = {"held_out 4": file, "truth 4": "truth.png"} if seed == 0 else {}
        found.append(RunResult(spec=spec, status="done", metrics=numbers, pictures=pictures))
    return found


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    Results(runs=results(folder), store=ResultStore(folder)).write(folder)
    return f"file://{folder}/page.html"


@pytest.fixture
def open_page(lab, file):
    """``open_page(width, scheme)``: the page in a window of that width; no request may leave it, no
    error may come."""
    wrong = []
    contexts = []

    def open_it(width=1280, scheme="light", **options):
        context = lab.browser.new_context(
            viewport={"width": width, "height": 900}, color_scheme=scheme, offline=True, **options
        )
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda e: wrong.append(str(e)))
        page.on("console", lambda m: wrong.append(m.text) if m.type == "error" else None)
        page.on(
            "request",
            lambda r: None if r.url.startswith(("file:", "data:")) else wrong.append(r.url),
        )
        page.goto(file)
        return page

    yield open_it
    for context in contexts:
        context.close()
    assert wrong == []


def first_labels(page):
    return page.locator(".one-table:visible tbody tr").evaluate_all(
        "rows => rows.map(r => r.dataset.label)"
    )


def test_sorting_choosing_and_menus_by_keyboard(open_page):
    page = open_page()
    assert first_labels(page) == list(PSNR)
    page.get_by_role("button", name="Time per frame, ms").focus()
    page.keyboard.press("Enter")
    assert first_labels(page) == list(PSNR)
    page.keyboard.press("Enter")
    assert first_labels(page) == list(PSNR)[::-1]
    assert (
        page.locator(".one-table:visible th[aria-sort=descending]")
        .inner_text()
        .startswith("Time per frame")
    )
    page.get_by_label("Scene", exact=True).select_option("kitchen")
    page.get_by_label("Budget", exact=True).select_option("own size, own steps")
    assert page.locator(".one-table:visible caption").inner_text() == "kitchen, own size, own steps"
    page.get_by_role("button", name="with a <long> name & more").focus()
    page.keyboard.press("Enter")
    assert (
        page.locator("#of-rule h3").inner_text()
        == "with a <long> name & more: kitchen, own size, own steps, seed 0"
    )
    assert page.locator("#of-rule img").count() == 3
    page.get_by_role("button", name="Close").press("Enter")
    assert page.locator("#of-rule").is_hidden()
    assert page.evaluate("document.activeElement.textContent") == "with a <long> name & more"
    page.get_by_label("Scene", exact=True).select_option("all: ranks")
    assert page.locator(".one-table:visible thead button").all_inner_texts() == [
        "rule",
        "room, dB",
        "kitchen, dB",
        "Mean, dB",
        "Mean rank",
        "Rule minus reference, dB",
        "p",
    ]


def test_two_rules_by_slider_flicker_errors_and_nearness(lab, open_page):
    page = open_page()
    page.get_by_label("A", exact=True).select_option("quadtree")
    page.get_by_label("B", exact=True).select_option("with a <long> name & more")
    assert (
        "quadtree is better than with a <long> name & more by 2.8"
        in page.locator("#verdict").inner_text()
    )
    divide = page.get_by_label("Dividing line")
    divide.focus()
    for _ in range(10):
        page.keyboard.press("ArrowLeft")
    assert (
        page.locator(".stage .over").evaluate("e => e.style.clipPath") == "inset(0px 0px 0px 40%)"
    )
    page.locator(".stage").scroll_into_view_if_needed()
    box = page.locator(".stage").bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 50)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 50)
    page.mouse.up()
    assert abs(int(divide.input_value()) - 25) <= 1

    page.get_by_label("flicker").check()
    shown = page.locator(".stage .tag")
    lab.wait_for(lambda: "long" in shown.inner_text(), "the second picture", 5)
    page.get_by_role("button", name="Pause").click()
    page.get_by_role("button", name="Swap").click()
    assert shown.inner_text() == "quadtree"

    page.get_by_label("errors").check()
    assert page.locator("#comparison img").count() == 2
    assert page.locator("#comparison .ends").inner_text().split() == [
        "no",
        "error",
        "25%",
        "or",
        "more",
    ]

    page.get_by_label("which is nearer").check()
    lab.wait_for(
        lambda: page.locator("#comparison canvas").evaluate("c => c.width") == 64, "the canvas", 5
    )
    red, blue = page.locator("#comparison canvas").evaluate(
        """c => {
            const data = c.getContext("2d").getImageData(0, 0, 64, 48).data;
            return [0, 2].map((k) => data.filter((_, i) => i % 4 === k).reduce((a, b) => a + b, 0));
        }"""
    )
    assert blue > red  # quadtree is nearer almost everywhere
    page.get_by_label("B", exact=True).select_option("recorded picture")
    assert page.locator("#verdict").inner_text() == ""


def test_flicker_waits_for_people_who_want_no_motion(open_page):
    page = open_page(reduced_motion="reduce")
    page.get_by_label("flicker").check()
    assert page.get_by_role("button", name="Play").is_visible()


@pytest.mark.parametrize(
    ("width", "scheme"),
    [(1280, "light"), (1280, "dark"), (400, "light"), (400, "dark")],
)
def test_it_fits_and_can_be_read(lab, open_page, width, scheme):
    page = open_page(width, scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    weak = page.evaluate(CONTRAST)
    assert weak == []
    lab.screenshot(page.locator("main"), f"lab_page_{width}_{scheme}")


def test_without_scripts_all_tables_are_there(open_page):
    page = open_page(java_script_enabled=False)
    assert page.locator(".one-table:visible").count() == 6
    assert page.locator("#comparison").is_hidden()


def test_the_live_table_in_a_notebook(lab):
    page = lab.open([LIVE])
    status = page.locator(".gsnb-lab-status")
    table = page.locator(".gsnb-lab-stored").first  # the short one
    page.locator(".gsnb-lab-start").click()
    lab.wait_for(lambda: "frame" in status.inner_text(), "frames")
    page.locator(".gsnb-lab-pause").click()
    lab.wait_for(lambda: "paused" in status.inner_text(), "the pause")
    assert lab.run(page, "print(6 * 7)") == "42"
    page.locator(".gsnb-lab-start").click()
    lab.wait_for(lambda: "finished" in status.inner_text(), "the end", 300)
    assert table.locator("tr").count() == 3
    lab.screenshot(page.locator(".gsnb-lab").first, "lab_live_table")
    lab.run(page, "live.close()")
    page.close()
    assert lab.errors == []


CONTRAST = """() => {
  const parse = (c) => {
    const [r, g, b, alpha] = c.match(/[\\d.]+/g).map(Number);
    return [r, g, b, alpha ?? 1];
  };
  const light = ([r, g, b]) => {
    const f = (v) => ((v /= 255) <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    return 0.2126 * f(r) + 0.7152 * f(g) + 0.0722 * f(b);
  };
  const behind = (e) => {
    for (; e; e = e.parentElement) {
      const c = parse(getComputedStyle(e).backgroundColor);
      if (c[3] === 1) return c;
    }
    return [255, 255, 255, 1];
  };
  const weak = [];
  for (const e of document.querySelectorAll("main *")) {
    const own = [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
    if (!own || !e.checkVisibility() || e.closest("svg, .sr, .tag, option")) continue;
    const text = light(parse(getComputedStyle(e).color));
    const ground = light(behind(e));
    const contrast = (Math.max(text, ground) + 0.05) / (Math.min(text, ground) + 0.05);
    const words = e.textContent.trim().slice(0, 40);
    if (contrast < 4.5) weak.push(`${e.tagName}.${e.className}: ${words}`);
  }
  return weak;
}"""
