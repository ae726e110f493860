"""Every rule has an option that decides its number of Gaussians, or is known to have none."""

import pytest
import torch

from gsfusion_nb.lab import RunSpec
from gsfusion_nb.lab.rule_variants import thinned
from gsfusion_nb.lab.size_options import SIZE_OPTIONS, size_option, start_value, with_size
from gsfusion_nb.seeding import SeedContext, apply_rule, is_built_in, registered
from gsfusion_nb.types import Camera, Frame

WITHOUT = {"dense"}


def test_every_rule_of_the_package_is_covered():
    assert {name for name, rule in registered().items() if is_built_in(rule)} == set(SIZE_OPTIONS) | WITHOUT


@pytest.mark.parametrize("name", SIZE_OPTIONS)
def test_the_option_exists_and_its_usual_value_is_in_range(name):
    spec, rule = RunSpec(rule=name), registered()[name]
    option = size_option(spec, rule)
    start = start_value(spec, rule, option)
    assert option.low <= start <= option.high
    smaller = with_size(spec, option, start / 2 if isinstance(start, float) else max(start // 2, 1))
    assert start_value(smaller, rule, option) < start
    assert smaller.label == spec.label
    smaller.config()


@pytest.mark.parametrize("name", ["edge_discs", "edge_strokes"])
def test_a_share_of_a_function_and_of_a_class_is_drawn(name):
    camera = Camera(width=64, height=48, fx=50.0, fy=50.0, cx=32.0, cy=24.0)
    frame = Frame(
        index=0, timestamp_s=0.0, rgb=torch.rand(48, 64, 3), depth_m=torch.full((48, 64), 2.0), camera=camera,
        T_WC=torch.eye(4),
    )  # fmt: skip
    some = thinned(registered()[name], 0.25)
    every, quarter = (len(apply_rule(r, SeedContext(frame), {"coverage": False})) for r in (name, some))
    assert quarter == round(every / 4) > 10
