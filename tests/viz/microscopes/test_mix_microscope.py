"""What is mixed in a pixel of GPS-SLAM: the microscope says what the renderer drew, in any order."""

from types import SimpleNamespace

import pytest
import torch

from gsfusion_nb.render import BaseView, render_over_base
from gsfusion_nb.render.over_base import Base
from gsfusion_nb.types import Camera, GaussianParams
from gsfusion_nb.viz import MixMicroscope
from gsfusion_nb.viz.panels.pixel_microscope import mix_table

CAMERA = Camera(width=80, height=60, fx=60.0, fy=60.0, cx=40.0, cy=30.0)
EYE = torch.eye(4)


@pytest.fixture
def mapper(generator):
    """200 Gaussians around a wall at 2 m, of which the left edge is a hole; some of them are far behind it."""
    n, size = 200, (CAMERA.height, CAMERA.width)
    xyz = torch.rand(n, 3, generator=generator) * torch.tensor([2.4, 1.8, 0.6]) + torch.tensor([-1.2, -0.9, 1.8])
    params = GaussianParams(
        xyz_W=xyz, log_scale=torch.full((n, 3), -2.0), quat=torch.randn(n, 4, generator=generator),
        opacity_logit=torch.randn(n, generator=generator), sh=torch.randn(n, 1, 3, generator=generator) * 0.3,
    )  # fmt: skip
    depth_m, weight = torch.full(size, 2.0), torch.ones(size)
    depth_m[:, :8], weight[:, :8] = 0.0, 0.0
    base = Base(rgb=torch.full((*size, 3), 0.4), depth_m=depth_m, weight=weight)
    below = BaseView(base=base, depth_everywhere_m=depth_m, behind_m=0.1)
    output = render_over_base(params, CAMERA, EYE, base, behind_m=0.1)[0]
    return SimpleNamespace(
        gaussians=SimpleNamespace(params=params), below=lambda *_: below, render=lambda *_: output, output=output
    )


def test_the_mean_is_the_rendered_pixel_in_any_order(mapper, generator):
    microscope = MixMicroscope(mapper, CAMERA, EYE)
    hidden = 0
    for u, v in ((40, 30), (3, 20), (79, 59), (0, 0)):
        mix = microscope.look_at(u, v)
        torch.testing.assert_close(mix.colour, mapper.output.rgb[v, u], rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(mix.total, float(mapper.output.weight[v, u]), rtol=1e-5, atol=1e-5)
        other = mix.shuffled(generator)
        torch.testing.assert_close(other.colour, mix.colour, rtol=1e-5, atol=1e-6)
        assert sorted(other.row.tolist()) == sorted(mix.row.tolist())
        assert torch.equal(mix.running[0], mix.base_rgb * (mix.base_weight > 0))
        hidden += mix.hidden
    assert hidden > 0


def test_a_click_shows_another_mix_with_words(mapper):
    microscope = MixMicroscope(mapper, CAMERA, EYE, pixel=(10, 10))
    before = microscope.table.value, microscope.graph.value
    microscope.clicks.pixel = (50, 40)
    assert (microscope.stack.u, microscope.stack.v) == (50, 40)
    assert before[0] != microscope.table.value == mix_table(microscope.stack)
    assert before[1] != microscope.graph.value
    assert "surface and" in microscope.caption.value
    assert "two orders" in microscope.graph.alt
    bundle = microscope._repr_mimebundle_()
    assert "image/png" in str(bundle) or "image/jpeg" in str(bundle)
