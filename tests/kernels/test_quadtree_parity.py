"""The numba quadtree beyond what ``test_parity.py`` compares: large pictures, refusals, threads."""

import dataclasses

import pytest
import torch
from kernel_cases.quadtree import noise_and_ramp

from gsfusion_nb.backends import use_backend
from gsfusion_nb.seeding import quadtree

pytest.importorskip("numba")


def same_leaves(image, **settings):
    with use_backend("numba"):
        ours = quadtree(image, **settings)
    with use_backend("reference"):
        theirs = quadtree(image, **settings)
    for column in dataclasses.fields(theirs):
        a = getattr(ours, column.name)
        b = getattr(theirs, column.name)
        assert a.dtype == b.dtype
        assert torch.equal(a, b), column.name
    return ours


@pytest.mark.parametrize("threshold", [0.0, 1e-3])
@pytest.mark.parametrize("contrast", ["released", "std"])
def test_large_pictures(threshold, contrast):
    cells = same_leaves(noise_and_ramp(641, 479), threshold=threshold, contrast=contrast)
    assert int(cells.area.sum()) == 641 * 479


def test_halves_of_the_extreme_colours():
    halves = torch.zeros(48, 64, 3, dtype=torch.uint8)
    halves[:, 31:] = 255
    assert len(same_leaves(halves, threshold=0.0)) > 10
