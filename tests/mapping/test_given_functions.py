"""What a loss and an optimiser that are given to a mapper see and may return."""

import dataclasses
import functools

import pytest
import torch
from small_configs import CONFIGS

from gsfusion_nb.data import open_sequence
from gsfusion_nb.errors import ArgumentError, UnknownNameError
from gsfusion_nb.export import CheckpointStore
from gsfusion_nb.mapping import make_mapper
from gsfusion_nb.mapping.training import Training
from gsfusion_nb.optim import TrainingView, ViewLoss, l1_mse_vjp
from gsfusion_nb.runs.sound_state import check_values
from gsfusion_nb.types import GaussianParams, RenderOutput


def labels(frame):
    """1 in the right half of the picture, where the number of the frame is even."""
    right = torch.arange(frame.camera.width) >= frame.camera.width // 2
    return {"right": (right & (frame.index % 2 == 0)).expand(frame.camera.height, -1).byte()}


def sequence_of(name):
    return open_sequence("room", n_frames=240, data=CONFIGS[name].data, extra=labels)


def mapped(name, **given):
    mapper = make_mapper(CONFIGS[name], **given)
    for frame in sequence_of(name).mapping:
        mapper.step(frame)
    for _ in mapper.global_optimise(1):
        pass
    return mapper


def colours(rendered, view):
    pixels = l1_mse_vjp(rendered.rgb, view.rgb)
    return ViewLoss(value=pixels.value, v_rgb=pixels.v_rgb)


@functools.cache
def coloured(name):
    """A map that was optimised by colours, for tests that do not change it."""
    return mapped(name, loss=colours)


def thinner(rendered, view):
    """Colours, and a pull on alpha towards 0."""
    loss = colours(rendered, view)
    return dataclasses.replace(
        loss,
        value=loss.value + rendered.alpha.mean(),
        v_alpha=torch.full_like(rendered.alpha, 1 / rendered.alpha.numel()),
    )


def smaller(rendered, view):
    """Colours, and a strong pull on all sizes."""
    loss = colours(rendered, view)
    sizes = view.params.log_scale
    return dataclasses.replace(
        loss, value=loss.value + sizes.sum(), v_params={"log_scale": torch.ones_like(sizes)}
    )


@pytest.mark.parametrize("name", ["gsfusion", "rtg_slam"])
def test_a_loss_of_alpha_makes_a_map_more_transparent(name):
    if name == "rtg_slam":  # its opacities are fixed; centres and sizes follow
        assert mean_of(mapped(name, loss=thinner), "log_scale") < mean_of(
            coloured(name), "log_scale"
        )
        return
    plain = mean_of(coloured(name), "opacity_logit")
    assert mean_of(mapped(name, loss=thinner), "opacity_logit") < plain - 0.01


def mean_of(mapper, column):
    return float(getattr(mapper.gaussians.params, column).mean())


@pytest.mark.parametrize("name", CONFIGS)
def test_a_loss_of_parameters_reaches_them(name):
    plain = mean_of(coloured(name), "log_scale")
    assert mean_of(mapped(name, loss=smaller), "log_scale") < plain - 0.01


@pytest.mark.parametrize("name", CONFIGS)
def test_a_loss_sees_the_further_images_of_frames_and_keyframes(name):
    seen = {}

    def watching(rendered, view):
        seen[view.index] = view.extra["right"].clone()
        assert rendered.rgb.shape[:2] == view.extra["right"].shape
        return colours(rendered, view)

    mapper = mapped(name, loss=watching)
    frames = {frame.index: frame for frame in sequence_of(name).mapping}
    assert len(seen) >= 2
    for index, image in seen.items():
        assert torch.equal(image, frames[index].extra["right"])
    assert all("right" in keyframe.extra for keyframe in mapper.keyframes)
    frame = sequence_of(name).mapping[0]
    plain = make_mapper(CONFIGS[name])
    plain.step(frame)
    assert not any(keyframe.extra for keyframe in plain.keyframes)
    with pytest.raises(UnknownNameError, match="no extra image 'left'; it has: right"):
        mapper.keyframes[0].extra["left"]


@pytest.mark.parametrize("name", CONFIGS)
def test_a_checkpoint_holds_the_further_images_and_is_sound(name, tmp_path, same):
    mapper = coloured(name)
    store = CheckpointStore(tmp_path)
    store.save({"mapper": mapper.state_dict(copies=False)})
    state = CheckpointStore(tmp_path).load().state
    check_values(state)
    again = type(mapper).from_state_dict(state["mapper"], loss=colours)
    same(again.state_dict(), mapper.state_dict())
    assert all("right" in keyframe.extra for keyframe in again.keyframes)


def test_an_optimiser_is_told_the_column():
    columns = set()

    def told(param, gradient, m, v, steps, *, lr, column):
        columns.add((column, param.shape[1:]))
        param -= lr * gradient

    mapped("gsfusion", optimiser=told)
    mapped("rtg_slam", optimiser=told)
    names = {"xyz_W": (3,), "log_scale": (3,), "quat": (4,), "opacity_logit": ()}
    assert columns >= {(name, torch.Size(shape)) for name, shape in names.items()}
    assert {name for name, _ in columns} == {*names, "sh"}


def params_of(n):
    return GaussianParams(
        xyz_W=torch.zeros(n, 3),
        log_scale=torch.zeros(n, 3),
        quat=torch.ones(n, 4),
        opacity_logit=torch.zeros(n),
        sh=torch.zeros(n, 1, 3),
    )


@pytest.mark.parametrize(
    ("gradients", "with_geometry", "message"),
    [
        (
            {"v_alpha": torch.full((3, 4), torch.nan)},
            True,
            "v_alpha of the loss 'made' must be fin",
        ),
        ({"v_alpha": torch.zeros(3, 4)}, False, "returned v_alpha, but this system's alpha has no"),
        ({"v_depth_m": torch.zeros(3, 4)}, False, "v_depth_m, but this system's depth has no"),
        ({"v_params": {"scale": torch.zeros(2, 3)}}, True, "no column.* 'scale'; known: log_scale"),
        ({"v_params": {"quat": torch.zeros(3, 4)}}, True, r"v_params\['quat'\] .* be \[2, 4\]"),
    ],
)
def test_a_gradient_that_fits_nothing_is_refused(gradients, with_geometry, message):
    def made(rendered, view):
        return ViewLoss(value=torch.tensor(0.0), v_rgb=torch.zeros(3, 4, 3), **gradients)

    picture = RenderOutput(
        rgb=torch.zeros(3, 4, 3),
        depth_m=torch.zeros(3, 4),
        alpha=torch.zeros(3, 4),
        first_index=None,
        dominant_index=None,
    )
    camera = sequence_of("gsfusion").camera.resized(4, 3)
    view = TrainingView(
        rgb=torch.zeros(3, 4, 3),
        depth_m=torch.zeros(3, 4),
        camera=camera,
        T_WC=torch.eye(4),
        pixels=torch.ones(3, 4, dtype=torch.bool),
    )
    with pytest.raises((ArgumentError, UnknownNameError), match=message):
        Training(loss=made).view_loss(picture, view, params_of(2), with_geometry=with_geometry)
