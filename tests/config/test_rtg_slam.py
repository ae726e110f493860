"""Presets carry the published numbers, survive JSON, and refuse what makes no sense."""

import dataclasses
import math

import pytest

from gsfusion_nb.config import rtg_slam, rtg_slam_fidelity

PRESETS = ("replica", "tum", "scannetpp", "azure", "room")
FIDELITIES = ("measured", "paper", "code")


@pytest.mark.parametrize("fidelity", ["code", "paper"])
@pytest.mark.parametrize(
    ("preset", "every", "iterations", "frames", "lr_dc", "lr_scale", "delta_eta", "delta_t"),
    [
        ("replica", 6, 50, 5, 5e-4, 4e-3, 100, 120),
        ("tum", 4, 50, 5, 1e-3, 0.02, 200, 150),
        ("scannetpp", 3, 75, 1, 5e-4, 4e-3, 400, 200),
        ("azure", 8, 50, 3, 1e-3, 2e-3, 250, 400),
    ],
)
def test_published_numbers_of_each_data_set(
    preset, every, iterations, frames, lr_dc, lr_scale, delta_eta, delta_t, fidelity
):
    c = rtg_slam(preset, fidelity)
    w = c.window
    assert (w.every_frames, w.iterations, w.frames) == (every, iterations, frames)
    assert (w.lr_xyz, w.lr_sh_dc, w.lr_log_scale) == (1e-3, lr_dc, lr_scale)
    assert (c.states.stable_confidence, c.states.unstable_frames) == (delta_eta, delta_t)
    assert c.keyframes.iterations == iterations
    assert c.sh_degree == 3
    assert c.data.depth_min_m == 0.3
    assert c.data.depth_max_m == {"scannetpp": 10.0, "azure": 2.5}.get(preset, 5.0)


def test_what_the_paper_says():
    c = rtg_slam("replica", "paper")
    assert c.discs.opaque_alpha == pytest.approx(math.exp(-0.5))
    assert c.discs.min_cosine == pytest.approx(math.cos(math.radians(60)))
    assert c.discs.max_offset is None
    w = c.window
    assert (w.weight_colour, w.anchor, w.draw, w.history_max_weight) == (
        1.0,
        "birth",
        "random",
        1.0,
    )
    assert w.depth_behind_m is None
    s = c.states
    assert (s.colour_error, s.depth_error_m, s.on_error) == (0.1, 0.1, "release")
    assert s.max_radius_factor is None
    k = c.keyframes
    assert (k.latest, k.random, k.rows, k.instead_of_window) == (1, 3, "all", False)
    assert c.final.passes == 10
    released = rtg_slam("replica", "code").tracking
    # the rest is not in the paper
    assert c.tracking == dataclasses.replace(released, target="model")
    assert c.tracking.pyramid == (4, 2, 1)
    assert not c.tracking.landmarks


def test_what_the_released_code_does():
    c = rtg_slam("replica", "code")
    assert (c.discs.opaque_alpha, c.discs.max_offset, c.discs.min_cosine) == (0.6, 1.0, 0.5)
    w = c.window
    assert (w.weight_colour, w.anchor, w.draw, w.history_max_weight) == (
        0.8,
        "window",
        "newest_half",
        0.5,
    )
    assert w.depth_behind_m == 0.1
    s = c.states
    assert s.colour_error == pytest.approx(0.2 / 3)  # 0.2 of the sum over R, G, B
    assert (s.depth_error_m, s.on_error) == (0.2, "delete")
    assert s.error_count + 1 == 10  # ">= 10" there, "above" here
    assert s.max_radius_factor == 10.0
    k = c.keyframes
    assert (k.latest, k.random, k.rows, k.instead_of_window) == (3, 0, "stable", True)
    assert (c.final.passes, c.final.lr_factor, c.final.weight_depth) == (20, 4.0, 0.0)
    for other in ("tum", "scannetpp", "azure"):
        o = rtg_slam(other, "code")
        assert (o.final.passes, o.final.lr_factor) == (10, 1.0)
        assert o.keyframes.instead_of_window == (other != "scannetpp")
    t = c.tracking
    assert (t.pyramid, t.iterations, t.max_distance_m, t.max_angle_deg) == (
        (4, 2, 1),
        (5, 5, 5),
        0.1,
        20.0,
    )
    assert (t.prior, t.target) == ("previous", "hybrid")
    assert not t.landmarks
    assert rtg_slam("replica").tracking.landmarks


@pytest.mark.parametrize("fidelity", FIDELITIES)
@pytest.mark.parametrize("preset", PRESETS)
def test_settings_know_what_they_follow(preset, fidelity):
    assert rtg_slam_fidelity(rtg_slam(preset, fidelity, seed=3)) == fidelity
    changed = rtg_slam(preset, fidelity, window__history_max_weight=0.7)
    assert rtg_slam_fidelity(changed) == f"{fidelity}, but window.history_max_weight 0.7"


def test_overrides_reach_nested_fields():
    c = rtg_slam("tum", "paper", window__iterations=30, tracking__back_end=True, mesh_voxel_m=0.05)
    assert (c.window.iterations, c.window.every_frames) == (30, 4)
    assert c.tracking.back_end
    assert c.mesh_voxel_m == 0.05
    with pytest.raises(
        ValueError, match=r"window: unknown keys \['iteration'\]; known: .*'iterations'"
    ):
        rtg_slam("tum", window__iteration=20)
    with pytest.raises(KeyError, match="no preset 'repilca'; known: azure, online, replica"):
        rtg_slam("repilca")
    with pytest.raises(KeyError, match="no fidelity 'papre'; known: code, measured, paper"):
        rtg_slam("room", "papre")
