"""Which depth is not mapped, and which options would map it."""

import pytest
import torch

from gsfusion_nb.config import gps_slam, gsfusion, rtg_slam
from gsfusion_nb.data.adjust.depth_range import DepthRange

RANGE = DepthRange(near_m=0.4, far_m=6.0)


def depths_m(*parts):
    """1,000 pixels: each part is a share and a depth, the rest has none."""
    values = torch.zeros(1000)
    start = 0
    for share, depth_m in parts:
        end = start + round(1000 * share)
        values[start:end] = depth_m
        start = end
    return values.reshape(25, 40)


def test_shares_are_of_the_measured_pixels():
    outside = RANGE.outside(depths_m((0.1, 0.2), (0.3, 2.0), (0.1, 9.0)))
    assert outside.nearer == pytest.approx(0.2)
    assert outside.farther == pytest.approx(0.2)


def test_sentence_and_flags_name_both_sides():
    outside = RANGE.outside(depths_m((0.1, 0.2), (0.3, 2.0), (0.1, 9.0)))
    assert outside.is_much
    assert outside.sentence == (
        "20% of the measured depth is nearer than tsdf.near_m (0.4 m) and 20% is farther than "
        "tsdf.far_m (6 m), where nothing is mapped"
    )
    assert outside.flags == "--tsdf.near-m 0.18 --tsdf.far-m 9.9"


def test_a_side_that_is_inside_is_not_named():
    outside = RANGE.outside(depths_m((0.5, 0.2), (0.5, 2.0)))
    assert "far" not in outside.sentence
    assert outside.flags == "--tsdf.near-m 0.18"


@pytest.mark.parametrize(("share", "is_much"), [(0.1, False), (0.102, True)])
def test_a_tenth_is_usual(share, is_much):
    outside = RANGE.outside(depths_m((share, 7.0), (1 - share, 2.0)))
    assert outside.is_much is is_much


def test_both_ends_of_the_range_are_mapped():
    outside = RANGE.outside(torch.tensor([0.4, 6.0], dtype=torch.float64))
    assert outside.nearer == outside.farther == 0


def test_without_any_depth_nothing_is_left_out():
    assert not RANGE.outside(torch.zeros(3, 4)).is_much


def test_a_side_without_limit_leaves_nothing_out():
    config = rtg_slam(data__depth_max_m=0.0)
    outside = DepthRange.of(config).outside(depths_m((1.0, 500.0)))
    assert not outside.is_much


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        (gsfusion(tsdf__near_m=0.3), DepthRange(near_m=0.3, far_m=6.0)),
        (gps_slam(tsdf__far_m=7.0), DepthRange(near_m=0.4, far_m=7.0)),
        (
            rtg_slam(data__depth_min_m=0.2),
            DepthRange(near_m=0.2, far_m=5.0, settings=("data.depth_min_m", "data.depth_max_m")),
        ),
    ],
    ids=["gsfusion", "gps_slam", "rtg_slam"],
)
def test_range_of_a_system(config, expected):
    depth_range = DepthRange.of(config)
    assert depth_range == expected
    assert depth_range.limits_reading is (depth_range.settings[0] == "data.depth_min_m")
