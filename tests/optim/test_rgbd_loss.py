"""The loss as printed, its gradient by finite differences and by autograd, and which pixels count."""

import math

import pytest
import torch

from gsfusion_nb.optim import rgbd_l1_vjp


def pictures(generator, height: int = 5, width: int = 7, dtype=torch.float64):
    """Rendered and measured colour and depth, some depth missing in each."""

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=dtype)

    def holes(depth_m: torch.Tensor) -> torch.Tensor:
        return torch.where(uniform(height, width) < 0.2, 0.0, depth_m)

    rgb, target_rgb = uniform(height, width, 3), uniform(height, width, 3)
    depth_m, target_m = holes(1 + uniform(height, width)), holes(1 + uniform(height, width))
    pixels = uniform(height, width) < 0.7
    return rgb, depth_m, target_rgb, target_m, pixels


def written_out(rgb, depth_m, target_rgb, target_m, pixels, w_c, w_d, behind_m) -> torch.Tensor:
    """Pixel by pixel, term by term."""
    colour, depth = [], []
    for y in range(rgb.shape[0]):
        for x in range(rgb.shape[1]):
            if not pixels[y, x]:
                continue
            colour.extend((rgb[y, x, c] - target_rgb[y, x, c]).abs() for c in range(3))
            if depth_m[y, x] <= 0 or target_m[y, x] <= 0:
                continue
            if behind_m is None or depth_m[y, x] - target_m[y, x] < behind_m:
                depth.append((depth_m[y, x] - target_m[y, x]).abs())
    return w_c * torch.stack(colour).mean() + w_d * torch.stack(depth).mean()


def test_by_hand():
    rgb, target = torch.zeros(1, 2, 3), torch.tensor([[[0.3, 0.0, -0.6], [9.0, 9.0, 9.0]]])
    depth, target_m = torch.tensor([[2.5, 1.0]]), torch.tensor([[2.0, 9.0]])
    only_first = torch.tensor([[True, False]])
    loss = rgbd_l1_vjp(rgb, depth, target, target_m, only_first, weight_colour=0.8, weight_depth=2.0)
    assert loss.colour == pytest.approx(0.3)
    assert loss.depth_m == pytest.approx(0.5)
    assert loss.total == pytest.approx(0.8 * 0.3 + 2.0 * 0.5)
    torch.testing.assert_close(loss.v_rgb, torch.tensor([[[-0.8 / 3, 0.0, 0.8 / 3], [0.0, 0.0, 0.0]]]))
    torch.testing.assert_close(loss.v_depth_m, torch.tensor([[2.0, 0.0]]))


@pytest.mark.parametrize("behind_m", [None, 0.1, -0.2])
@pytest.mark.parametrize("weights", [(1.0, 1.0), (0.8, 0.3), (0.0, 1.0)])
def test_value_and_gradient_of_the_printed_formula(generator, behind_m, weights):
    rgb, depth_m, *rest = pictures(generator)
    target_rgb, target_m, pixels = rest
    leaves = rgb.clone().requires_grad_(), depth_m.clone().requires_grad_()
    expected = written_out(leaves[0], leaves[1], target_rgb, target_m, pixels, weights[0], weights[1], behind_m)
    expected.backward()
    loss = rgbd_l1_vjp(rgb, depth_m, *rest, weight_colour=weights[0], weight_depth=weights[1], behind_m=behind_m)
    assert loss.total == pytest.approx(float(expected.detach()), rel=1e-12)
    torch.testing.assert_close(loss.v_rgb, leaves[0].grad)
    torch.testing.assert_close(loss.v_depth_m, leaves[1].grad)


def test_gradient_by_finite_differences(generator):
    rgb, depth_m, *rest = pictures(generator, 3, 4)
    loss = rgbd_l1_vjp(rgb, depth_m, *rest, weight_depth=0.7, behind_m=0.1)
    h = 1e-6
    for image, v in ((rgb, loss.v_rgb), (depth_m, loss.v_depth_m)):
        numeric = torch.zeros_like(image)
        for i in range(image.numel()):
            if image is depth_m and depth_m.flatten()[i] == 0:
                continue  # a pixel without a disc is not on the curve
            ends = []
            for step in (h, -h):
                shifted = image.clone()
                shifted.view(-1)[i] += step
                both = (shifted, depth_m) if image is rgb else (rgb, shifted)
                ends.append(rgbd_l1_vjp(*both, *rest, weight_depth=0.7, behind_m=0.1).total)
            numeric.view(-1)[i] = (ends[0] - ends[1]) / (2 * h)
        torch.testing.assert_close(v, numeric, atol=1e-8, rtol=1e-6)


def test_no_pixels_no_loss(generator):
    rgb, depth_m, target, target_m, pixels = pictures(generator)
    loss = rgbd_l1_vjp(rgb, depth_m, target, target_m, torch.zeros_like(pixels))
    assert (loss.colour, loss.depth_m, loss.total) == (0.0, 0.0, 0.0)
    assert not loss.v_rgb.any()
    assert not loss.v_depth_m.any()


@pytest.mark.parametrize("missing", ["rendered", "measured"])
def test_without_depth_only_colour_counts(generator, missing):
    rgb, depth_m, target, target_m, pixels = pictures(generator)
    nothing = torch.zeros_like(depth_m)
    depths = (nothing, target_m) if missing == "rendered" else (depth_m, nothing)
    loss = rgbd_l1_vjp(rgb, depths[0], target, depths[1], pixels)
    assert loss.depth_m == 0.0
    assert loss.total == loss.colour > 0
    assert not loss.v_depth_m.any()


def test_far_behind_the_measurement_does_not_count_but_far_in_front_does():
    depth, target_m = torch.tensor([[2.05, 2.2, 1.0]]), torch.full((1, 3), 2.0)
    rgb = torch.zeros(1, 3, 3)
    loss = rgbd_l1_vjp(rgb, depth, rgb, target_m, torch.ones(1, 3, dtype=torch.bool), behind_m=0.1)
    assert loss.depth_m == pytest.approx((0.05 + 1.0) / 2)
    torch.testing.assert_close(loss.v_depth_m, torch.tensor([[0.5, 0.0, -0.5]]))


def test_equal_images_have_no_gradient(generator):
    rgb, depth_m, _, _, pixels = pictures(generator)
    loss = rgbd_l1_vjp(rgb, depth_m, rgb, depth_m, pixels)
    assert loss.total == 0.0
    assert not loss.v_rgb.any()
    assert not loss.v_depth_m.any()


def test_values_outside_the_mask_may_be_anything(generator):
    rgb, depth_m, target, target_m, pixels = pictures(generator)
    clean = rgbd_l1_vjp(rgb, depth_m, target, target_m, pixels)
    rgb[~pixels] = math.nan
    loss = rgbd_l1_vjp(rgb, depth_m, target, target_m, pixels)
    assert loss.total == clean.total
    assert torch.equal(loss.v_rgb, clean.v_rgb)
