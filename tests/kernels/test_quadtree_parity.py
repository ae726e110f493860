"""The numba quadtree beyond what ``test_parity.py`` compares: large pictures, refusals, threads."""

import dataclasses

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.kernels.quadtree.cases import noise_and_ramp
from gsfusion_nb.seeding import quadtree

pytest.importorskip("numba")


def same_leaves(image, **settings):
    with use_backend("numba"):
        ours = quadtree(image, **settings)
    with use_backend("torch"):
        theirs = quadtree(image, **settings)
    for column in dataclasses.fields(theirs):
        a, b = getattr(ours, column.name), getattr(theirs, column.name)
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


def test_wrong_arguments_are_refused():
    with use_backend("numba"):
        for image, settings in (
            (torch.zeros(4, 4, 3, dtype=torch.uint8), {"threshold": -1.0}),
            (torch.zeros(4, 4, 3, dtype=torch.uint8), {"min_cell_px": 0}),
            (torch.zeros(0, 4, 3, dtype=torch.uint8), {}),
        ):
            with pytest.raises(ValueError, match="must"):
                quadtree(image, **settings)


def test_any_number_of_threads_gives_the_same():
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        results.append(same_leaves(noise_and_ramp(320, 240), threshold=1e-4))
    torch.set_num_threads(1)
    assert torch.equal(results[0].x0, results[1].x0)
    assert torch.equal(results[0].level, results[1].level)
