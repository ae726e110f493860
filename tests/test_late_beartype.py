"""The tests' type checker finds a wrong argument, a wrong result, and a result that does not fit the arguments."""

import pytest
import torch
from jaxtyping import Float, TypeCheckError, jaxtyped
from late_beartype import beartype
from torch import Tensor


@jaxtyped(typechecker=beartype)
def doubled(x: Float[Tensor, "N 3"], times: int = 2, *, wrong: object = None) -> Float[Tensor, "N 3"]:
    return 2 * x if wrong is None else wrong  # pyright: ignore[reportReturnType]


def test_what_fits_passes():
    for n in (4, 5):
        assert doubled(torch.ones(n, 3)).sum() == 6 * n


@pytest.mark.parametrize("x", [torch.ones(4, 2), torch.ones(4, 3, dtype=torch.int64), [1.0]])
def test_a_wrong_argument(x):
    with pytest.raises(TypeCheckError, match="checking the parameters"):
        doubled(x)
    with pytest.raises(TypeCheckError, match="parameter 'times'"):
        doubled(torch.ones(4, 3), "2")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("result", [torch.ones(4, 2), torch.ones(5, 3), torch.ones(4, 3).long(), "4 x 3"])
def test_a_wrong_result(result):
    with pytest.raises(TypeCheckError, match="checking the return value"):
        doubled(torch.ones(4, 3), wrong=result)
