"""Every rule has an option that decides its number of Gaussians, or is known to have none."""

import pytest

from gsfusion_nb.lab import RunSpec
from gsfusion_nb.lab.size_options import SIZE_OPTIONS, size_option, start_value, with_size
from gsfusion_nb.seeding import is_built_in, registered

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
