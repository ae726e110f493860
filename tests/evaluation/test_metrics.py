"""Numbers as people read them, and both counts of frames per second."""

import json
import math

import pytest

from gsfusion_nb.evaluation import NotComputed, format_metric, frame_rates, metrics_as_json


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("psnr_held_out_db", 23.6789, "23.68\u00a0dB"),
        ("ssim_mapped", 0.81234, "0.812"),
        ("n_gaussians", 1234567, "1,234,567"),
        ("mesh_accuracy_m", 0.0123, "1.23\u00a0cm"),
        ("mesh_completion_ratio", 0.5, "50.0\u00a0%"),
        ("rpe_rotation_deg", 0.5, "0.500°"),
        ("psnr_mapped_db", math.inf, "∞\u00a0dB"),
        ("psnr_mapped_db", math.nan, "not computed: the result is not a number"),
        ("lpips_mapped", NotComputed("no weights"), "not computed: no weights"),
        ("lpips_mapped", {"not_computed": "no weights"}, "not computed: no weights"),
        ("n_keyframes", None, "not computed: not measured in this run"),
        ("something_new", 0.123456, "0.1235"),
        ("something_new", "text", "text"),
    ],
)
def test_format(name, value, text):
    assert format_metric(name, value) == text


def test_json_is_strict_and_comes_back():
    metrics = {"a": 1.5, "b": math.nan, "c": NotComputed("why"), "d": math.inf, "e": None}
    text = json.dumps(metrics_as_json(metrics), allow_nan=False)
    assert json.loads(text)["c"] == {"not_computed": "why"}
    assert format_metric("lpips_mapped", json.loads(text)["c"]) == "not computed: why"
    assert json.loads(text)["d"] == "infinite"


def test_both_frame_rates_by_hand():
    rates = frame_rates([0.1, 0.4])
    assert rates["fps_total"] == pytest.approx(4.0)
    assert rates["fps_mean_inverse"] == pytest.approx((10 + 2.5) / 2)
    assert isinstance(frame_rates([])["fps_total"], NotComputed)
    assert isinstance(frame_rates([0.1, 0.0])["fps_mean_inverse"], NotComputed)
