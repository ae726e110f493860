"""Findings on intrinsics: what is measured becomes the option of a reader, and a sentence."""

import dataclasses
import math

import pytest

from gsfusion_nb.config import RepairConfig
from gsfusion_nb.recordings.checkup.agreement import CalibrationCorrection
from gsfusion_nb.recordings.checkup.explain import Explanation, repair_of
from gsfusion_nb.recordings.checkup.fit import FittedCorrection
from gsfusion_nb.recordings.checkup.judge_intrinsics import intrinsics_findings
from gsfusion_nb.types import Camera

CAMERA = Camera(fx=500.0, fy=540.0, cx=300.0, cy=220.0, width=640, height=480)
KINDS = ("focal length", "fx / fy", "principal point")


def findings(correction: CalibrationCorrection, camera: Camera = CAMERA, centre_px: float = 0.1):
    """The findings, by name, on a recording that this correction mends clearly."""
    repair = repair_of(correction, camera, RepairConfig())
    fits = {
        kind: FittedCorrection(
            kind=kind,
            added={},
            ratio=0.5,
            uncertainty=centre_px if kind == "principal point" else 0.001,
        )
        for kind in KINDS
    }
    e = object.__new__(Explanation)  # of what was measured, only these are looked at
    vars(e).update(repair=repair, fits=fits, adopted=fits, contradicted=frozenset())
    return repair, {f.name: f for f in intrinsics_findings(e, camera, None)}


def test_exchanged_focal_lengths_are_set_exactly():
    correction = CalibrationCorrection(log_aspect=math.log(540 / 500) + 0.003)
    repair, found = findings(correction)
    assert (repair.fx, repair.fy) == (CAMERA.fy, CAMERA.fx)
    assert found["focal length"].verdict == "wrong"
    assert "fx 540.0, fy 500.0: they are exchanged" in found["focal length"].sentence
    assert found["focal length"].repair == repair.flags


def test_focal_lengths_that_are_wrong_otherwise_are_not_called_exchanged():
    for correction in (
        CalibrationCorrection(log_aspect=math.log(540 / 500) + 0.02),
        CalibrationCorrection(log_focal=0.05),
    ):
        repair, found = findings(correction)
        assert (repair.fx, repair.fy) != (CAMERA.fy, CAMERA.fx)
        assert "exchanged" not in found["focal length"].sentence
    square = dataclasses.replace(CAMERA, fy=500.0)
    assert (
        "exchanged"
        not in findings(CalibrationCorrection(log_aspect=0.02), square)[1]["focal length"].sentence
    )


def test_an_exchanged_principal_point_is_set_exactly():
    repair, found = findings(CalibrationCorrection(cx_px=-78.0, cy_px=81.0))
    assert (repair.cx, repair.cy) == (CAMERA.cy, CAMERA.cx)
    assert "220.0, 300.0: cx and cy are exchanged" in found["principal point"].sentence
    assert "pixel centres" not in found
    repair, found = findings(CalibrationCorrection(cx_px=-70.0, cy_px=80.0))
    assert (repair.cx, repair.cy) == (230.0, 300.0)
    assert "exchanged" not in found["principal point"].sentence


@pytest.mark.parametrize(("shift", "size"), [(0.5, "too small"), (-0.5, "too large")])
def test_half_a_pixel_is_a_shift_of_both(shift, size):
    repair, found = findings(CalibrationCorrection(cx_px=shift + 0.1, cy_px=shift - 0.15))
    assert repair == RepairConfig(pixel_shift=shift)
    assert found["pixel centres"].verdict == "wrong"
    assert found["pixel centres"].repair == f"--data.repair.pixel-shift {shift}"
    assert f"half a pixel {size}" in found["pixel centres"].sentence
    assert found["principal point"].verdict == "ok"


def test_half_a_pixel_to_the_right_alone_is_another_principal_point():
    repair, found = findings(CalibrationCorrection(cx_px=0.5))
    assert repair == RepairConfig(cx=300.5, cy=220.0)
    assert "pixel centres" not in found


def test_pixel_centres_are_known_only_where_the_principal_point_is():
    assert findings(CalibrationCorrection())[1]["pixel centres"].verdict == "ok"
    found = findings(CalibrationCorrection(), centre_px=0.6)[1]["pixel centres"]
    assert found.verdict == "unknown"
    assert "no measurable difference" in found.sentence
