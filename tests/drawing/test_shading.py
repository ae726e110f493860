"""The one lamp of all grey surfaces: no wall is white or black, and each looks different."""

import pytest
import torch

from gsfusion_nb.drawing.shading import NOTHING, light_on, shaded, shaded_view

HEAD_ON = torch.tensor([0.0, 0.0, -1.0])


def test_by_hand():
    """Seen from the front: 0.34 + 0.50 * 0.55 / |(0.45, 0.70, 0.55)| + 0.15 * 0.60 / |(0.8, 0.1,
    0.6)|."""
    key = 0.55 / (0.45**2 + 0.70**2 + 0.55**2) ** 0.5
    fill = 0.60 / (0.80**2 + 0.10**2 + 0.60**2) ** 0.5
    assert float(light_on(HEAD_ON)) == pytest.approx(0.34 + 0.50 * key + 0.15 * fill)


def test_no_surface_is_white_or_black_and_sides_differ(generator):
    normals = torch.nn.functional.normalize(torch.randn(2000, 3, generator=generator), dim=1)
    normals[:, 2] = -normals[:, 2].abs()
    grey = shaded(normals)
    assert float(grey.min()) > 0.3
    assert float(grey.max()) < 0.93
    sides = [[-1.0, 0, 0], [0, -1, 0], [1, 0, 0], [0, 1, 0]]
    left, top, right, bottom = light_on(torch.tensor(sides))
    assert top > left > right > bottom


def test_colours_stay_colours_and_nothing_is_seen_as_such():
    rgb = torch.tensor([0.8, 0.4, 0.2])
    lit = shaded(HEAD_ON, rgb)
    assert torch.allclose(lit / lit.sum(), rgb / rgb.sum())
    assert torch.allclose(lit, rgb, atol=0.02)
    view = shaded_view(HEAD_ON.expand(1, 2, 3), torch.tensor([[True, False]]))
    assert view[0, 1].tolist() == pytest.approx(NOTHING)
    assert torch.equal(view[0, 0], shaded(HEAD_ON))
