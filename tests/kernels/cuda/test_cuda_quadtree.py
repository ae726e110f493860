"""The quadtree: identical leaves in identical order."""

import dataclasses
import importlib

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.seeding import quadtree


def picture(width: int, height: int, generator: torch.Generator) -> torch.Tensor:
    """Noise on the left, a gradient on the right."""
    noise = torch.randint(
        0,
        256,
        (height, width, 3),
        generator=generator,
        dtype=torch.uint8,
    )
    ramp = torch.linspace(0, 255, width)[None, :, None].expand(height, width, 3).to(torch.uint8)
    return torch.where(
        (torch.arange(width) < width // 2)[None, :, None],
        noise,
        ramp,
    )


def assert_same_leaves(image, device, **settings):
    """``image`` on the processor; the leaves of the kernels."""
    with use_backend("cuda"):
        ours = quadtree(image.to(device), **settings)
    with use_backend("numba"):
        theirs = quadtree(image, **settings)
    for column in dataclasses.fields(theirs):
        a = getattr(ours, column.name)
        b = getattr(theirs, column.name)
        assert a.dtype == b.dtype
        assert torch.equal(a.cpu(), b), column.name
    return ours


@pytest.mark.parametrize(
    "size",
    [
        (1, 1),
        (1, 500),
        (500, 3),
        (500, 4),
        (4, 4),
        (5, 7),
        (9, 8),
        (64, 48),
        (97, 61),
        (320, 240),
        (331, 259),
    ],
)
@pytest.mark.parametrize("contrast", ["released", "std"])
def test_same_leaves(size, contrast, generator, device):
    image = picture(size[0], size[1], generator)
    found = []
    for threshold in (0.0, 1e-5, 1e-3, 0.1):
        cells = assert_same_leaves(image, device, threshold=threshold, contrast=contrast)
        assert int(cells.area.sum()) == size[0] * size[1]
        found.append(len(cells))
    assert found == sorted(found, reverse=True)


@pytest.mark.parametrize("climb", [(0, 1), (1, 0), (2, 3)])
def test_any_number_of_passes(climb, generator, device, monkeypatch):
    """Pictures from 1537 x 1537 on need three."""
    module = importlib.import_module("gsfusion_nb.kernels.quadtree.cuda")
    monkeypatch.setattr(
        module, "_CLIMB", dict(zip(("sum_cells", "add_levels"), climb, strict=True))
    )
    for size in ((97, 61), (150, 131)):
        assert_same_leaves(picture(*size, generator), device, threshold=1e-5)


def test_a_tree_of_one_level_in_a_large_picture(generator, device):
    """Its four leaves are summed in parts."""
    image = picture(640, 480, generator)
    for min_cell_px, leaves in ((239, 4), (240, 1), (10**12, 1)):
        assert (
            len(assert_same_leaves(image, device, threshold=0.0, min_cell_px=min_cell_px)) == leaves
        )


def test_a_contrast_equal_to_the_threshold_does_not_cut(device):
    """Half black, half white: the deviation is half of the range, but for the weights, which add up
    to 0.9999."""
    halves = torch.zeros(4, 4, 3, dtype=torch.uint8)
    halves[:, 2:] = 255
    at = 0.5 * 0.9999**0.5
    for threshold in (at - 1e-12, at, at + 1e-12):
        assert_same_leaves(halves, device, threshold=threshold, contrast="std")
    assert len(assert_same_leaves(halves, device, threshold=at + 1e-12, contrast="std")) == 1
    assert len(assert_same_leaves(halves, device, threshold=at - 1e-12, contrast="std")) == 4


def test_strided_pictures(generator, device):
    image = picture(64, 48, generator)
    expected = assert_same_leaves(image, device, threshold=1e-4)
    strided = image.to(device).permute(2, 0, 1).contiguous().permute(1, 2, 0)
    with use_backend("cuda"):
        assert torch.equal(quadtree(strided, threshold=1e-4).x0, expected.x0)
        sparse = quadtree(image.to(device)[::2, 1::3], threshold=1e-4)
    assert torch.equal(
        sparse.x0,
        assert_same_leaves(image[::2, 1::3], device, threshold=1e-4).x0,
    )
