"""Passes over keyframes: all once each, another order each time, to be stopped and resumed anywhere."""

import itertools

import pytest
import torch

from gsfusion_nb.mapping.training import KeyframePasses


def visits(passes: KeyframePasses, n: int, keyframes: int, generator, limit: int | None = None) -> list[int]:
    seen: list[int] = []

    def optimise(i: int) -> torch.Tensor:
        seen.append(i)
        return torch.tensor(float(i))

    for _ in itertools.islice(passes.run(n, keyframes, generator, optimise), limit):
        pass
    return seen


def test_each_pass_visits_all_once_in_a_new_order(generator):
    passes = KeyframePasses()
    assert not passes.begun
    seen = visits(passes, 3, 10, generator)
    parts = [seen[k : k + 10] for k in (0, 10, 20)]
    assert [sorted(p) for p in parts] == [list(range(10))] * 3
    assert parts[0] != parts[1]
    assert (passes.done, passes.queue, passes.begun) == (3, [], True)


@pytest.mark.parametrize("stop", [1, 4, 5, 7])
def test_going_on_after_a_stop_is_the_same_as_no_stop(stop):
    whole = visits(KeyframePasses(), 2, 5, torch.Generator().manual_seed(3))
    generator, passes = torch.Generator().manual_seed(3), KeyframePasses()
    first = visits(passes, 2, 5, generator, stop)
    state = passes.state_dict()
    visits(passes, 1, 5, torch.Generator())  # what was saved stays as it was
    resumed = KeyframePasses()
    resumed.load_state_dict(state, n_keyframes=5)
    assert resumed.begun
    left = 2 - resumed.done
    assert first + visits(resumed, left, 5, generator) == whole
