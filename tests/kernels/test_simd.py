from typing import NamedTuple

import numpy as np
import pytest

numba = pytest.importorskip("numba")

from gsfusion_nb.kernels.runtime.numba import simd  # noqa: E402  # pyright: ignore[reportMissingImports]


@numba.njit
def _exp(x, y):
    simd.store(y, 0, simd.exp(simd.load(x, 0)))


@numba.njit
def _mixture(x, y, out):
    a = simd.load(x, 0)
    b = simd.load(y, 0)
    chosen = simd.select(
        a < b,
        simd.minimum(a, b) + simd.splat(np.float32(1)),
        simd.negative_abs(simd.maximum(a, b)),
    )
    simd.store(out, 0, chosen)
    return simd.any_lane(a > b), simd.any_lane((a > b) & (a < b)), simd.reduce_add(simd.iota() * a)


class Near(NamedTuple):
    """One way to look up."""

    rows: np.ndarray


class Far(NamedTuple):
    """Another one, of the same fields."""

    rows: np.ndarray


_shift = simd.splat_of_class(lambda table: 3 if table is Near else 5)


@numba.njit
def _shift_is(table, number):
    return simd.any_lane(_shift(table) == simd.splat_int(np.int32(number)))


def test_a_number_of_the_class_of_a_tuple():
    rows = np.zeros(1, np.int32)
    assert [_shift_is(Near(rows), 3), _shift_is(Near(rows), 5)] == [True, False]
    assert [_shift_is(Far(rows), 3), _shift_is(Far(rows), 5)] == [False, True]


@pytest.mark.parametrize(
    ("low", "high", "tolerance"),
    [(-6.0, 0.0, 6e-7), (-86.0, -6.0, 5e-6)],
)
def test_exp_is_accurate(low, high, tolerance):
    """A splat is cut at ln(1/255) = -5.5; beyond, the rounding of x log2(e) grows with |x|."""
    for x in np.linspace(low, high, 320, dtype=np.float32).reshape(20, 16):
        y = np.empty(16, np.float32)
        _exp(np.ascontiguousarray(x), y)
        np.testing.assert_allclose(
            y,
            np.exp(x.astype(np.float64)),
            rtol=tolerance,
        )


def test_lane_operations():
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 16)).astype(np.float32)
    out = np.empty(16, np.float32)
    greater, never, total = _mixture(x, y, out)
    np.testing.assert_array_equal(
        out,
        np.where(x < y, np.minimum(x, y) + 1, -np.abs(np.maximum(x, y))),
    )
    assert greater == bool((x > y).any())
    assert not never
    assert total == pytest.approx(float((np.arange(16) * x).sum()), rel=1e-5)


@numba.njit
def _swap_first_and_last(pixels, swapped):
    first, second, third = simd.load_triples(pixels, 3)
    simd.store_triples(swapped, 6, third, second, first)


def test_triples_are_split_and_joined():
    pixels = np.arange(3 * 20, dtype=np.float32)
    swapped = np.full(3 * 20, -1, np.float32)
    _swap_first_and_last(pixels, swapped)
    np.testing.assert_array_equal(
        swapped[6:54].reshape(16, 3), pixels[3:51].reshape(16, 3)[:, ::-1]
    )
    assert (swapped[:6] == -1).all()
    assert (swapped[54:] == -1).all()


@numba.njit
def _store_wide(numbers, wide):
    simd.store_wide(wide, 2, simd.load(numbers, 0))


def test_whole_lanes_become_integers():
    numbers = np.array([-1, 0, 1, 2**24 - 1] * 4, np.float32)
    wide = np.full(20, 7, np.int64)
    _store_wide(numbers, wide)
    np.testing.assert_array_equal(wide, [7, 7, *numbers.astype(np.int64), 7, 7])
