import pytest

from gsfusion_nb.compare.bench.scaling import exponent


@pytest.mark.parametrize(("p", "factor"), [(1.0, 3.0), (0.5, 0.1), (2.0, 7.0), (0.0, 1.0)])
def test_a_power_law_gives_its_exponent(p, factor):
    assert exponent([(x, factor * x**p) for x in (1e3, 2e3, 5e3, 2e5)]) == pytest.approx(p, abs=1e-9)
