"""The search for a value: few evaluations, whatever the direction, and a sentence where nothing fits."""

import pytest

from gsfusion_nb.compare.tune import NotReachedError, Search


def found(count, start, target, low=1e-6, high=100.0, tolerance=0.02, whole=False):
    search = Search(target=target, start=start, low=low, high=high, tolerance=tolerance, whole=whole)
    while (value := search.next_value()) is not None:
        search.tell(value, count(value))
    return search.found(), len(search.counts)


CURVES = {
    "proportional": lambda v: 1000 * v,
    "inverse": lambda v: 300 / v,
    "falls slowly": lambda v: 3000 * v**-0.3,
    "step": lambda v: 100 if v < 3 else 5000 * v,
    "saturates": lambda v: 1200 * v / (1 + v),
}


@pytest.mark.parametrize("name", ["proportional", "inverse", "falls slowly", "saturates"])
@pytest.mark.parametrize("start", [0.01, 0.5, 20.0])
def test_it_finds_the_value_in_few_runs(name, start):
    value, n_runs = found(CURVES[name], start, 900.0)
    assert CURVES[name](value) == pytest.approx(900, rel=0.02)
    assert n_runs <= 10


def test_whole_numbers():
    value, n_runs = found(lambda v: 10 * v, 3, 500.0, low=1, high=1000, whole=True)
    assert (value, n_runs) == (50, 3)
    with pytest.raises(NotReachedError, match=r"[23] gives [46]00 and [23] gives [46]00"):
        found(lambda v: 200 * v, 9, 500.0, low=1, high=1000, whole=True)


@pytest.mark.parametrize(
    ("curve", "message"),
    [
        (lambda v: min(1000 * v, 700), "gives 700"),
        (lambda v: 0, "this changes nothing: .* both give 0"),
        (lambda v: max(5000.0, v), "this changes nothing: 0.1 and .* both give 5,000"),
    ],
)
def test_what_cannot_be_reached_is_said_soon(curve, message):
    runs = []

    def count(v):
        runs.append(v)
        return curve(v)

    with pytest.raises(NotReachedError, match=message):
        found(count, 0.1, 900.0, high=1.0)
    assert len(runs) <= 9


def test_a_jump_over_the_target_ends():
    with pytest.raises(NotReachedError, match="gives 100 and"):
        found(CURVES["step"], 0.5, 900.0)
