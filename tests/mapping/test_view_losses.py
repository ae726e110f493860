"""The loss of a view in GSFusion and GPS-SLAM: its gradient is that of its value, with every weight
of the settings."""

import dataclasses

import pytest
import torch

from gsfusion_nb.config import gps_slam, replace
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.large_maps import MapPart
from gsfusion_nb.mapping import GSFusion
from gsfusion_nb.mapping.gps_slam import loss_of_view
from gsfusion_nb.mapping.gps_views import SurfaceKeyframe
from gsfusion_nb.mapping.training import Training
from gsfusion_nb.optim import Keyframe, depth_l1, dssim, expected_depth_l1, l1
from gsfusion_nb.render import OverBaseOutput
from gsfusion_nb.types import RenderOutput

STEP = 1e-3
"""Of finite differences; smaller than every difference of the pictures, so that no sign changes."""


@pytest.fixture
def frame(small_room):
    """A frame a part of which has no depth."""
    frame = small_room[0]
    depth_m = frame.depth_m.clone()
    depth_m[:20] = 0.0
    return dataclasses.replace(frame, depth_m=depth_m)


def away_from(image: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """An image that differs from another one everywhere, by 0.05 to 0.15, up or down."""
    size = 0.05 + 0.1 * torch.rand(image.shape, generator=generator)
    sign = torch.where(torch.rand(image.shape, generator=generator) < 0.5, -1.0, 1.0)
    return image + sign * size


def slope(loss, image: torch.Tensor, direction: torch.Tensor) -> float:
    """How fast a loss of an image rises in a direction, by central differences."""
    high = float(loss(image + STEP * direction))
    low = float(loss(image - STEP * direction))
    return (high - low) / (2 * STEP)


@pytest.mark.parametrize(("ssim_weight", "depth_weight"), [(0.0, 0.0), (0.3, 0.0), (0.3, 0.7)])
def test_gsfusion_weighs_colour_structure_and_depth(
    config, frame, generator, ssim_weight, depth_weight
):
    mapper = GSFusion(replace(config, optim__depth_weight=depth_weight))
    part = MapPart(mapper.gaussians)
    rgb = away_from(frame.rgb, generator)
    depth_m = away_from(frame.depth_m, generator)

    def loss_of(rgb: torch.Tensor, depth_m: torch.Tensor):
        picture = RenderOutput(
            rgb=rgb,
            depth_m=depth_m,
            alpha=torch.ones_like(depth_m),
            first_index=None,
            dominant_index=None,
        )
        return mapper._loss(picture, part, frame, frame.rgb, ssim_weight)[0]

    found = loss_of(rgb, depth_m)
    expected = (1 - ssim_weight) * l1(rgb, frame.rgb) + ssim_weight * dssim(rgb, frame.rgb)
    expected = expected + depth_weight * depth_l1(depth_m, frame.depth_m)
    torch.testing.assert_close(found.value, expected)

    # along the signs of the gradient the slope is largest, and float32 resolves it best
    direction = found.v_rgb.sign()
    rise = slope(lambda image: loss_of(image, depth_m).value, rgb, direction)
    assert float((found.v_rgb * direction).sum()) == pytest.approx(rise, rel=2e-2)
    if not depth_weight:
        assert found.v_depth_m is None
        return
    assert found.v_depth_m is not None
    direction = found.v_depth_m.sign()
    rise = slope(lambda image: loss_of(rgb, image).value, depth_m, direction)
    assert float((found.v_depth_m * direction).sum()) == pytest.approx(rise, rel=2e-2)
    assert not found.v_depth_m[:20].any()


def test_gsfusion_divides_the_depth_by_alpha_where_it_is_asked_to(config, frame, generator):
    """Value and slopes along depth and alpha, where what is not mapped counts less; without the
    setting alpha does not count."""
    far_m = float(frame.depth_m.median())
    depth_m = away_from(frame.depth_m, generator)
    alpha = 0.6 + 0.3 * torch.rand(depth_m.shape, generator=generator)

    def loss_of(depth_m: torch.Tensor, alpha: torch.Tensor, over_alpha: bool = True):
        optim = {"depth_weight": 0.7, "depth_over_alpha": over_alpha, "depth_coverage": 0.4}
        mapper = GSFusion(replace(config, optim=optim, tsdf__far_m=far_m))
        picture = RenderOutput(
            rgb=frame.rgb, depth_m=depth_m, alpha=alpha, first_index=None, dominant_index=None
        )
        return mapper._loss(picture, MapPart(mapper.gaussians), frame, frame.rgb, 0.0)[0]

    found = loss_of(depth_m, alpha)
    expected = 0.7 * expected_depth_l1(depth_m, alpha, frame.depth_m, 0.4, far_m)
    assert expected < 0.7 * expected_depth_l1(depth_m, alpha, frame.depth_m, 0.4)
    torch.testing.assert_close(found.value, expected)
    assert found.v_depth_m is not None
    direction = found.v_depth_m.sign()
    rise = slope(lambda image: loss_of(image, alpha).value, depth_m, direction)
    assert float((found.v_depth_m * direction).sum()) == pytest.approx(rise, rel=2e-2)
    assert found.v_alpha is not None
    direction = found.v_alpha.sign()
    rise = slope(lambda image: loss_of(depth_m, image).value, alpha, direction)
    assert float((found.v_alpha * direction).sum()) == pytest.approx(rise, rel=2e-2)
    as_it_is = loss_of(depth_m, alpha, over_alpha=False)
    assert as_it_is.v_alpha is None
    torch.testing.assert_close(as_it_is.value, 0.7 * depth_l1(depth_m, frame.depth_m))


@pytest.mark.parametrize(("kind", "power"), [("l1", 1), ("l2", 2)])
def test_gps_slam_has_the_loss_of_its_settings(frame, generator, kind, power):
    config = gps_slam("room", residual__loss=kind)
    seen = torch.zeros_like(frame.rgb)
    keyframe = Keyframe.of(frame)
    view = SurfaceKeyframe.of(keyframe, seen, torch.zeros_like(frame.depth_m), config.base)
    params = GaussianModel(sh_degree=0).params
    rgb = away_from(frame.rgb, generator)

    def loss_of(rgb: torch.Tensor):
        flat = torch.zeros_like(frame.depth_m)
        picture = OverBaseOutput(rgb=rgb, depth_m=flat, weight=flat)
        return loss_of_view(config, Training(), view, frame.rgb, params, picture)[0]

    found = loss_of(rgb)
    torch.testing.assert_close(found.value, (rgb - frame.rgb).abs().pow(power).mean())
    direction = found.v_rgb.sign()
    rise = slope(lambda image: loss_of(image).value, rgb, direction)
    assert float((found.v_rgb * direction).sum()) == pytest.approx(rise, rel=2e-2)
