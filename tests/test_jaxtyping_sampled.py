"""The tests' type checker finds a wrong argument, result or field in the first calls of each
test."""

from dataclasses import dataclass

import pytest
import torch
from beartype import beartype
from jaxtyping import Float, TypeCheckError, jaxtyped
from jaxtyping_sampled import CALLS
from torch import Tensor


@jaxtyped(typechecker=beartype)
def doubled(
    x: Float[Tensor, "N 3"], times: int = 2, *, wrong: object = None
) -> Float[Tensor, "N 3"]:
    return 2 * x if wrong is None else wrong  # pyright: ignore[reportReturnType]


def test_what_fits_passes():
    for n in (4, 5):
        assert doubled(torch.ones(n, 3)).sum() == 6 * n


@pytest.mark.parametrize(
    "x",
    [torch.ones(4, 2), torch.ones(4, 3, dtype=torch.int64), [1.0]],
)
def test_a_wrong_argument(x):
    with pytest.raises(TypeCheckError, match="checking the parameters"):
        doubled(x)
    with pytest.raises(TypeCheckError, match="parameter 'times'"):
        doubled(torch.ones(4, 3), "2")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "result",
    [torch.ones(4, 2), torch.ones(5, 3), torch.ones(4, 3).long(), "4 x 3"],
)
def test_a_wrong_result(result):
    with pytest.raises(TypeCheckError, match="checking the return value"):
        doubled(torch.ones(4, 3), wrong=result)


@jaxtyped(typechecker=beartype)
@dataclass
class Pair:
    first: Float[Tensor, "N 3"]
    second: Float[Tensor, " N"]


def test_a_wrong_field():
    Pair(torch.ones(4, 3), torch.ones(4))
    with pytest.raises(TypeCheckError, match="parameter 'second'"):
        Pair(torch.ones(4, 3), torch.ones(5))


@pytest.mark.parametrize("_", range(2))
def test_the_first_calls_of_each_test_are_checked(_):
    for _ in range(CALLS):
        with pytest.raises(TypeCheckError):
            doubled(torch.ones(4, 2))
    assert doubled(torch.ones(4, 2)).shape == (4, 2)
