"""The CPU quadtree against the reference: identical leaves in identical order."""

import dataclasses

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.seeding import quadtree

pytest.importorskip("numba")


def picture(width: int, height: int, generator: torch.Generator) -> torch.Tensor:
    """Noise on the left, a gradient on the right."""
    noise = torch.randint(0, 256, (height, width, 3), generator=generator, dtype=torch.uint8)
    ramp = torch.linspace(0, 255, width)[None, :, None].expand(height, width, 3).to(torch.uint8)
    return torch.where((torch.arange(width) < width // 2)[None, :, None], noise, ramp)


def assert_same_leaves(image, **settings):
    with use_backend("numba"):
        ours = quadtree(image, **settings)
    theirs = quadtree.reference(image, **settings)
    for column in dataclasses.fields(theirs):
        a, b = getattr(ours, column.name), getattr(theirs, column.name)
        assert a.dtype == b.dtype
        assert torch.equal(a, b), column.name
    return ours


@pytest.mark.parametrize(
    "size", [(1, 1), (1, 500), (500, 3), (4, 4), (5, 7), (64, 48), (97, 61), (320, 240), (641, 479)]
)
@pytest.mark.parametrize("threshold", [0.0, 1e-5, 1e-3, 0.1])
def test_same_leaves(size, threshold, generator):
    image = picture(size[0], size[1], generator)
    for contrast in ("released", "std"):
        cells = assert_same_leaves(image, threshold=threshold, contrast=contrast)
        assert int(cells.area.sum()) == size[0] * size[1]


@pytest.mark.parametrize("min_cell_px", [1, 2, 5, 1000])
def test_smallest_cells(min_cell_px, generator):
    assert_same_leaves(picture(123, 77, generator), threshold=1e-6, min_cell_px=min_cell_px)


def test_uniform_and_extreme_pictures():
    for value in (0, 255):
        assert len(assert_same_leaves(torch.full((40, 60, 3), value, dtype=torch.uint8), threshold=0.0)) == 1
    halves = torch.zeros(48, 64, 3, dtype=torch.uint8)
    halves[:, 31:] = 255
    assert len(assert_same_leaves(halves, threshold=0.0)) > 10


def test_strided_pictures(generator):
    image = picture(64, 48, generator)
    strided = image.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    expected = assert_same_leaves(image, threshold=1e-4)
    assert torch.equal(assert_same_leaves(strided, threshold=1e-4).x0, expected.x0)
    assert_same_leaves(image[::2, ::3], threshold=1e-4)


def test_wrong_arguments_are_refused(generator):
    with use_backend("numba"):
        for image, settings in (
            (torch.zeros(4, 4, 3, dtype=torch.uint8), {"threshold": -1.0}),
            (torch.zeros(4, 4, 3, dtype=torch.uint8), {"min_cell_px": 0}),
            (torch.zeros(0, 4, 3, dtype=torch.uint8), {}),
        ):
            with pytest.raises(ValueError, match="must"):
                quadtree(image, **settings)


def test_any_number_of_threads_gives_the_same(generator):
    image = picture(320, 240, generator)
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        results.append(assert_same_leaves(image, threshold=1e-4))
    torch.set_num_threads(1)
    assert torch.equal(results[0].x0, results[1].x0)
    assert torch.equal(results[0].level, results[1].level)
