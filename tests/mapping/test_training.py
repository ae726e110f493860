"""A loss and an optimiser that are given to a mapper from outside, in all three systems."""

from typing import Any

import pytest
import torch

from gsfusion_nb.config import gps_slam, gsfusion, replace, rtg_slam
from gsfusion_nb.data import open_sequence
from gsfusion_nb.errors import SequenceError
from gsfusion_nb.mapping import get_system, make_mapper
from gsfusion_nb.optim import ViewLoss, l1_mse_vjp
from gsfusion_nb.optim.adam import BETA1, BETA2, EPS, adam_update
from gsfusion_nb.runs import resume_mapping, run_mapping

SMALL: dict[str, Any] = {"data__width": 40, "data__height": 30, "data__stop": 6}
SYSTEMS = {
    "gsfusion": gsfusion("room", tsdf__voxel_size_m=0.05, seeding__quadtree_threshold=0.002, **SMALL),
    "rtg_slam": rtg_slam("room", **SMALL),
    "gps_slam": gps_slam("room", data__width=64, data__height=48, data__stop=16, tsdf__voxel_size_m=0.04),
}


def own_l1(rendered, view):
    """GSFusion's own loss, online, as if it were somebody else's."""
    pixels = l1_mse_vjp(rendered.rgb, view.rgb)
    return ViewLoss(value=pixels.value, v_rgb=pixels.v_rgb)


def charbonnier(rendered, view, eps=1e-3):
    gap = torch.where(view.pixels[..., None], rendered.rgb - view.rgb, 0.0)
    root, n = (gap.square() + eps**2).sqrt(), 3 * view.pixels.sum().clamp_min(1)
    return ViewLoss(value=root.sum() / n, v_rgb=gap / root / n)


def sgd(param, gradient, m, v, steps, *, lr):
    param -= 100 * lr * gradient


def own_adam(param, gradient, m, v, steps, *, lr):
    adam_update(param, gradient, m, v, None, lr=lr, beta1=BETA1, beta2=BETA2, eps=EPS)


def mapped(name, **given):
    config = SYSTEMS[name]
    mapper = make_mapper(config, **given)
    for frame in open_sequence("room", n_frames=240, data=config.data).mapping:
        mapper.step(frame)
    return mapper


def equal(a, b):
    columns = zip(vars(a.gaussians.params).values(), vars(b.gaussians.params).values(), strict=True)
    return all(torch.equal(x, y) for x, y in columns)


def test_the_systems_own_functions_given_from_outside_give_the_same_map_bit_for_bit():
    """GSFusion's L1 and its Adam without bias correction."""
    config = replace(SYSTEMS["gsfusion"], optim__online_ssim_weight=0.0, optim__depth_weight=0.0)
    assert config.optim.adam_steps == "none"
    mappers = [make_mapper(config), make_mapper(config, loss=own_l1), make_mapper(config, optimiser=own_adam)]
    for frame in open_sequence("room", data=config.data).mapping:
        for mapper in mappers:
            mapper.step(frame)
    assert len(mappers[0].gaussians) > 20
    assert equal(mappers[0], mappers[1])
    assert equal(mappers[0], mappers[2])
    assert [m.training.names for m in mappers] == [{}, {"loss": "own_l1"}, {"optimiser": "own_adam"}]


@pytest.mark.parametrize("name", list(SYSTEMS))
@pytest.mark.parametrize("given", [{"loss": charbonnier}, {"optimiser": sgd}])
def test_every_system_optimises_with_what_is_given(name, given):
    usual, own = mapped(name), mapped(name, **given)
    assert len(own.gaussians) > 0
    assert len(usual.gaussians) != len(own.gaussians) or not equal(usual, own)
    assert not own.gaussians.count_not_finite()
    if "optimiser" in given and name == "gsfusion":  # plain gradient descent uses no moments
        assert not any(column.any() for column in vars(own.gaussians.exp_avg).values())
    else:
        before, own_loss = usual.training.names, own.training.names
        assert (before, list(own_loss)) == ({}, list(given))


def test_a_depth_loss_reaches_the_gaussians_and_keyframes_keep_their_depth():
    """The own L1 with a depth term by hand is the setting ``optim.depth_weight``, bit for bit."""
    from gsfusion_nb.optim import depth_l1, depth_l1_vjp

    def with_depth(rendered, view):
        own = own_l1(rendered, view)
        value = own.value + 0.3 * depth_l1(rendered.depth_m, view.depth_m)
        return ViewLoss(value=value, v_rgb=own.v_rgb, v_depth_m=depth_l1_vjp(rendered.depth_m, view.depth_m, 0.3))

    config = replace(
        SYSTEMS["gsfusion"], optim__online_ssim_weight=0.0, optim__depth_weight=0.3, optim__ssim_weight=0.0
    )
    config = replace(config, keyframe_every=2)
    mappers = [make_mapper(config), make_mapper(replace(config, optim__depth_weight=0.0), loss=with_depth)]
    for frame in open_sequence("room", data=config.data).mapping:
        for mapper in mappers:
            mapper.step(frame)
    for mapper in mappers:
        assert len(list(mapper.global_optimise(1))) == len(mapper.keyframes) > 1
    assert equal(*mappers)
    with pytest.raises(ValueError, match="v_depth_m"):
        mapped("gps_slam", loss=with_depth)


def not_in_place(param, gradient, m, v, steps, *, lr):
    param = param - lr * gradient


def returns(param, gradient, m, v, steps, *, lr):
    return param - lr * gradient


def to_nan(param, gradient, m, v, steps, *, lr):
    param /= v


@pytest.mark.parametrize(
    ("optimiser", "error"), [(not_in_place, ValueError), (returns, TypeError), (to_nan, ValueError)]
)
def test_an_optimiser_that_cannot_work_is_refused_before_the_first_frame(optimiser, error):
    with pytest.raises(error, match=optimiser.__name__):
        make_mapper(SYSTEMS["gsfusion"], optimiser=optimiser)
    with pytest.raises(TypeError, match="loss"):
        make_mapper(SYSTEMS["gsfusion"], loss=0.5)  # pyright: ignore[reportArgumentType]


def only_a_number(rendered, view):
    return (rendered.rgb - view.rgb).abs().mean()


def wrong_shape(rendered, view):
    return ViewLoss(value=rendered.rgb.mean(), v_rgb=rendered.rgb[:1])


def nan_gradient(rendered, view):
    return ViewLoss(value=rendered.rgb.mean(), v_rgb=rendered.rgb / 0.0)


@pytest.mark.parametrize(
    ("loss", "error"), [(only_a_number, TypeError), (wrong_shape, ValueError), (nan_gradient, ValueError)]
)
def test_a_loss_that_returns_something_else_is_named_and_the_map_is_unchanged(loss, error):
    mapper = make_mapper(SYSTEMS["gsfusion"], loss=loss)
    frame = open_sequence("room", data=SYSTEMS["gsfusion"].data).mapping[0]
    with pytest.raises(error, match=loss.__name__):
        mapper.step(frame)
    assert (len(mapper.gaussians), mapper.volume.n_blocks, mapper.n_frames) == (0, 0, 0)


@pytest.mark.parametrize("name", list(SYSTEMS))
def test_a_checkpoint_names_them_and_wants_them_again(name):
    state = mapped(name, loss=charbonnier, optimiser=sgd).state_dict()
    assert {kind: saved["name"] for kind, saved in state["training"].items()} == {
        "loss": "charbonnier",
        "optimiser": "sgd",
    }
    system = get_system(name)
    with pytest.raises(SequenceError, match="charbonnier"):
        system.from_state_dict(state, optimiser=sgd)
    again = system.from_state_dict(state, loss=charbonnier, optimiser=sgd)
    assert not again.notes
    assert again.training.names == {"loss": "charbonnier", "optimiser": "sgd"}
    [note] = system.from_state_dict(state, loss=own_l1, optimiser=sgd).notes
    assert "own_l1" in note
    assert "charbonnier" in note


class Interrupted(BaseException):
    """As Ctrl-C."""


def test_an_interrupted_run_goes_on_to_the_same_map(tmp_path):
    class StopAfter:
        def frame_mapped(self, mapper, frame, report):
            if mapper.n_frames == 3:
                raise Interrupted

        def finished(self, mapper, mesh, metrics):
            pass

    whole = run_mapping("room", SYSTEMS["gsfusion"], folder=tmp_path / "whole", evaluate=False, loss=charbonnier)
    with pytest.raises(Interrupted):
        run_mapping(
            "room", SYSTEMS["gsfusion"], folder=tmp_path / "cut", evaluate=False, loss=charbonnier, watch=StopAfter()
        )
    with pytest.raises(SequenceError, match="charbonnier"):
        resume_mapping(tmp_path / "cut", evaluate=False)
    resumed = resume_mapping(tmp_path / "cut", evaluate=False, loss=charbonnier)
    assert equal(whole.mapper, resumed.mapper)
