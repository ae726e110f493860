"""Compositing, its gradient, and Adam: the recorded numbers are those of the operation."""

import dataclasses

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import OptimConfig
from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.optim import adam_step
from gsfusion_nb.render import render_forward
from gsfusion_nb.types import Camera, GaussianParams, Seeds
from gsfusion_nb.viz import (
    adam_stepper,
    compositing_gradient_stepper,
    compositing_stepper,
    pixel_stack,
    project_splats,
)
from gsfusion_nb.viz.steppers.compositing import record_pixel

CAMERA = Camera(
    width=16,
    height=12,
    fx=14.0,
    fy=14.0,
    cx=8.0,
    cy=6.0,
)
T_WC = torch.eye(4)
PIXEL = (7, 6)


def stack(opacity):
    n = 9
    xyz = torch.tensor([[0.01 * k - 0.04, 0.02 * (k % 3), 1.0 + 0.1 * k] for k in range(n)])
    rgb = torch.rand(n, 3, generator=torch.Generator().manual_seed(0))
    model = GaussianModel(sh_degree=0)
    model.append(
        Seeds.isotropic(
            xyz,
            rgb,
            torch.full((n,), 0.1),
            opacity=opacity,
        )
    )
    return model.params


def test_compositing_ends_with_the_colour_of_the_pixel(press):
    params = stack(0.3)
    stepper = compositing_stepper(params, CAMERA, T_WC, PIXEL)
    press(stepper)
    with use_backend("reference"):
        rgb = render_forward(params, CAMERA, T_WC)[0].rgb[PIXEL[1], PIXEL[0]]
    torch.testing.assert_close(
        stepper.steps[-1].scene["colour"],
        rgb,
        atol=1e-6,
        rtol=0,
    )
    expected = pixel_stack(project_splats(params, CAMERA, T_WC), *PIXEL)
    torch.testing.assert_close(
        stepper.steps[-1].scene["w"],
        expected.weight,
        atol=1e-6,
        rtol=0,
    )


def test_compositing_says_where_the_pixel_is_finished(press):
    steps = press(compositing_stepper(stack(0.97), CAMERA, T_WC, PIXEL))
    finished = [numbers for title, numbers in steps if "the pixel is finished" in title]
    assert finished
    assert {numbers["w"] for numbers in finished} == {"0"}
    with pytest.raises(ValueError, match="outside"):
        compositing_stepper(stack(0.5), CAMERA, T_WC, (16, 0))


def test_the_gradient_is_that_of_autograd(press):
    params = stack(0.3)
    v_rgb = torch.tensor([0.2, -0.1, 0.4])
    stepper = compositing_gradient_stepper(params, CAMERA, T_WC, PIXEL, v_rgb)
    press(stepper)
    run = record_pixel(params, CAMERA, T_WC, PIXEL)
    alpha = run.recording.at("return torch.where(alpha >= ALPHA_MIN")[0]["return"][
        :, 0
    ].requires_grad_()
    T = torch.cat([torch.ones(1), (1 - alpha).cumprod(0)[:-1]])
    ((alpha * T) @ run.rgb @ v_rgb).backward()
    torch.testing.assert_close(
        stepper.steps[-2].scene["v_alpha"],
        alpha.grad,
        atol=1e-6,
        rtol=1e-5,
    )
    assert stepper.steps[0].scene["k"] == len(alpha) - 1


@pytest.mark.parametrize("count", ["per_row", "shared"])
def test_adam_moves_the_rows_as_the_optimiser_does(press, count):
    stepper = adam_stepper(
        (0.3, -0.1, 0.2),
        adam_steps=count,
        before=1,
        after=1,
        earlier_steps=5,
    )
    steps = press(stepper)
    model = GaussianModel(sh_degree=0)
    config = dataclasses.replace(OptimConfig(), adam_steps=count)
    model.clock.advance(5)
    for k, n in enumerate((2, 3)):
        if len(model) < n:
            new = n - len(model)
            size = torch.full((new,), 0.1)
            model.append(
                Seeds.isotropic(
                    torch.zeros(new, 3),
                    torch.full((new, 3), 0.5),
                    size,
                    opacity=0.5,
                )
            )
        zero = {name: torch.zeros_like(x) for name, x in vars(model.params).items()}
        gradient = torch.tensor([0.3, -0.1, 0.2])[:n]
        with use_backend("reference"):
            adam_step(model, GaussianParams(**zero | {"opacity_logit": gradient}), config)
        shown = [step for step in stepper.steps if step.title.startswith("The step of each row")][k]
        after = [float(row[2].replace("−", "-")) for row in shown.numbers]
        assert after == pytest.approx(model.params.opacity_logit.tolist(), rel=1e-3)
    new = next(k for k, (title, _) in enumerate(steps) if title.startswith("A new row"))
    assert [row[2] for row in stepper.steps[new + 2].numbers][
        -1
    ] == "0"  # m of the new row before its first step
