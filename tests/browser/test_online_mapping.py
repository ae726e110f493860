"""Chapters 6, 9 and 10 as a person uses them: start, pause, step and stop mapping; sliders made
from a rule; Amdahl."""

import time

import pytest

pytestmark = [pytest.mark.ci, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

MAP = """
import torch
torch.set_num_threads(1)
from gsfusion_nb import GSFusion, gsfusion, open_sequence
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.viz import LiveMapper
config = gsfusion("room", tsdf__voxel_size_m=0.02)
run = MappingRun(open_sequence("room", data=config.data, n_frames=60), GSFusion(config))
live = LiveMapper(run)
live.run_sync(1)
live
"""
SPLATS = """
splats = live.splats(width=320, height=240)
splats
"""
RULE = """
from gsfusion_nb.seeding import seeding_rule
from gsfusion_nb.viz.panels.seeding import rule_context, rule_panel
walk = open_sequence("room", data=config.data, n_frames=60)
context = rule_context(GSFusion(config), walk.mapping[0])

@seeding_rule
def near_only(ctx, *, max_depth_m: float = 3.0, invert: bool = False):
    seeds = ctx.cells()
    z = (seeds.xyz_W - ctx.frame.T_WC[:3, 3]) @ ctx.frame.T_WC[:3, 2]
    return seeds[(z < max_depth_m) != invert]

panel = rule_panel(near_only, context)
panel
"""
AMDAHL = """
from gsfusion_nb.viz.panels.stage_bars import amdahl_panel
bars = amdahl_panel({"tsdf": 0.008, "seeding": 0.002, "optimise": 0.04}, width=560)
bars
"""


@pytest.fixture(scope="module")
def page(lab):
    page = lab.open([MAP, SPLATS, RULE, AMDAHL])
    yield page
    lab.run(page, "live.player.close()")
    page.close()


def source(page, selector):
    return page.locator(f"{selector} img").first.get_attribute("src")


def test_start_pause_step_and_stop_online_mapping(lab, page):
    status = page.locator(".gsnb-live-status")
    status.scroll_into_view_if_needed()

    def mapped():
        return lab.value(page, "run.next_position")

    before = mapped()
    picture = source(page, ".gsnb-live-render")
    page.locator(".gsnb-live-start").click()
    lab.wait_for(lambda: mapped() >= before + 2, "frames to be mapped")
    lab.wait_for(lambda: source(page, ".gsnb-live-render") != picture, "a new picture")
    assert lab.run(page, "print(6 * 7)") == "42"  # the kernel is free while it maps

    page.locator(".gsnb-live-pause").click()
    lab.wait_for(lambda: "paused" in status.inner_text(), "the pause")
    rested = mapped()
    time.sleep(1.0)
    assert mapped() == rested
    lab.screenshot(page.locator(".gsnb-live").first, "chapter_06_paused")

    page.locator(".gsnb-live-step").click()
    lab.wait_for(lambda: mapped() == rested + 1, "one step")
    lab.wait_for(lambda: f"{rested + 1} of" in status.inner_text(), "the status")

    page.locator(".gsnb-live-stop").click()
    lab.wait_for(lambda: "stopped" in status.inner_text(), "the stop")
    lab.wait_for(lambda: not lab.value(page, "live.player.is_alive"), "the end of the thread")
    page.locator(".gsnb-live-start").click()  # goes on from there
    lab.wait_for(lambda: mapped() >= rested + 2, "frames after the stop")
    page.locator(".gsnb-live-stop").click()
    lab.wait_for(lambda: "stopped" in status.inner_text(), "the second stop")


def test_the_map_is_turned_while_it_grows(lab, page):
    scene = page.locator(".gsnb-splat-scene")
    scene.scroll_into_view_if_needed()
    lab.wait_for(
        lambda: lab.value(page, "splats.stats.get('pictures', 0)") > 0, "the first picture"
    )
    pixels = "document.querySelector('.gsnb-splat-software').toDataURL('image/png')"
    before = page.evaluate(pixels)
    last = lab.value(page, "splats.birth_range[1]")
    lab.run(page, "live.player.start()")
    lab.wait_for(
        lambda: lab.value(page, "splats.birth_range[1]") > last, "newer Gaussians in the viewer"
    )
    lab.wait_for(lambda: page.evaluate(pixels) != before, "a picture of them")

    pose = lab.value(page, "splats.pose")
    mapped = lab.value(page, "run.next_position")
    box = scene.bounding_box()
    page.mouse.move(box["x"] + 160, box["y"] + 120)
    page.mouse.down()
    page.mouse.move(box["x"] + 220, box["y"] + 140, steps=10)
    page.mouse.up()
    lab.wait_for(lambda: lab.value(page, "splats.pose") != pose, "the turn")
    lab.wait_for(lambda: lab.value(page, "run.next_position") > mapped, "mapping to go on")

    page.locator(".gsnb-splat-time").fill("0")  # the time slider goes back while the map grows
    lab.wait_for(lambda: lab.value(page, "splats.born_until") == 0, "the time slider")
    lab.wait_for(
        lambda: lab.value(page, "live.player.state") in ("running", "finished"),
        "no harm to the mapping",
    )
    lab.run(page, "live.player.stop(); splats.born_until = None")
    lab.wait_for(lambda: not lab.value(page, "live.player.is_alive"), "the stop")
    sent = "splats.birth_range[1] == float(run.mapper.gaussians.birth_frame.max())"
    lab.wait_for(lambda: lab.value(page, sent), "the last frame in the viewer")
    lab.screenshot(page.locator(".gsnb-splat-root").first, "chapter_06_splats_live")
    assert not lab.errors


def test_a_slider_made_from_a_keyword_moves_the_seeds(lab, page):
    page.locator(".gsnb-rule").scroll_into_view_if_needed()
    lab.screenshot(page.locator(".gsnb-rule").first, "chapter_09_rule")
    before = lab.value(page, "panel.values")
    picture = source(page, ".gsnb-rule-image")
    lab.move_slider(page.locator(".gsnb-rule-max_depth_m"), -6)
    lab.wait_for(
        lambda: lab.value(page, "panel.values")["max_depth_m"] < before["max_depth_m"], "the slider"
    )
    lab.wait_for(lambda: source(page, ".gsnb-rule-image") != picture, "a new picture")
    fewer = int(page.locator(".gsnb-rule-count").inner_text().replace(",", ""))
    page.locator(".gsnb-rule-invert input").click()
    lab.wait_for(
        lambda: int(page.locator(".gsnb-rule-count").inner_text().replace(",", "")) != fewer,
        "the check box to count",
    )
    lab.screenshot(page.locator(".gsnb-rule").first, "chapter_09_rule_inverted")


def test_a_faster_stage_shortens_the_bar(lab, page):
    page.locator(".gsnb-amdahl").scroll_into_view_if_needed()
    gain = page.locator(".gsnb-amdahl-gain")
    assert gain.inner_text() == "1.00"
    lab.move_slider(page.locator(".gsnb-amdahl-optimise"), 10)
    lab.wait_for(lambda: float(gain.inner_text()) > 1.3, "the gain")
    lab.screenshot(page.locator(".gsnb-amdahl").first, "chapter_10_amdahl")
    assert not lab.errors
    assert not lab.requests
