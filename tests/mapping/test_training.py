"""Loss, optimiser, passes and fits of poses and exposures."""

import contextlib
import copy
import dataclasses
import itertools
from typing import Any

import pytest
import torch

from gsfusion_nb.config import gps_slam, gsfusion, replace, rtg_slam
from gsfusion_nb.data import open_sequence
from gsfusion_nb.data.room import room
from gsfusion_nb.errors import SequenceError
from gsfusion_nb.gaussians.rigid_motion import move_map_
from gsfusion_nb.geometry import se3
from gsfusion_nb.mapping import GSFusion, get_system, make_mapper
from gsfusion_nb.mapping.after_scan import KeyframePasses
from gsfusion_nb.mapping.surfel_optimiser import BETA1, BETA2, EPS
from gsfusion_nb.mapping.training import Training
from gsfusion_nb.optim import TrainingView, ViewLoss, l1_mse_vjp
from gsfusion_nb.optim.adam import adam_update
from gsfusion_nb.types import Camera, RenderOutput

SMALL: dict[str, Any] = {"data__width": 40, "data__height": 30, "data__stop": 6}
SYSTEMS = {
    "gsfusion": gsfusion(
        "room", tsdf__voxel_size_m=0.05, seeding__quadtree_threshold=0.002, **SMALL
    ),
    "rtg_slam": rtg_slam("room", **SMALL),
    "gps_slam": gps_slam(
        "room", data__width=64, data__height=48, data__stop=16, tsdf__voxel_size_m=0.04
    ),
}


def own_l1(rendered, view):
    """GSFusion's own loss, online, as if it were somebody else's."""
    pixels = l1_mse_vjp(rendered.rgb, view.rgb)
    return ViewLoss(value=pixels.value, v_rgb=pixels.v_rgb)


def charbonnier(rendered, view, eps=1e-3):
    gap = torch.where(
        view.pixels[..., None],
        rendered.rgb - view.rgb,
        0.0,
    )
    root = (gap.square() + eps**2).sqrt()
    n = 3 * view.pixels.sum().clamp_min(1)
    return ViewLoss(value=root.sum() / n, v_rgb=gap / root / n)


def sgd(param, gradient, m, v, steps, *, lr):
    param -= 100 * lr * gradient


def own_adam(param, gradient, m, v, steps, *, lr):
    adam_update(
        param,
        gradient,
        m,
        v,
        None,
        lr=lr,
        beta1=BETA1,
        beta2=BETA2,
        eps=EPS,
    )


def mapped(name, **given):
    config = SYSTEMS[name]
    mapper = make_mapper(config, **given)
    for frame in open_sequence("room", n_frames=240, data=config.data).mapping:
        mapper.step(frame)
    return mapper


def equal(a, b):
    columns = zip(
        vars(a.gaussians.params).values(),
        vars(b.gaussians.params).values(),
        strict=True,
    )
    return all(torch.equal(x, y) for x, y in columns)


def test_the_systems_own_functions_given_from_outside_give_the_same_map_bit_for_bit():
    """GSFusion's L1 and its Adam without bias correction."""
    config = replace(SYSTEMS["gsfusion"], optim__online_ssim_weight=0.0, optim__depth_weight=0.0)
    assert config.optim.adam_steps == "none"
    mappers = [
        make_mapper(config),
        make_mapper(config, loss=own_l1),
        make_mapper(config, optimiser=own_adam),
    ]
    for frame in open_sequence("room", data=config.data).mapping:
        for mapper in mappers:
            mapper.step(frame)
    assert len(mappers[0].gaussians) > 20
    assert equal(mappers[0], mappers[1])
    assert equal(mappers[0], mappers[2])
    assert [m.training.names for m in mappers] == [
        {},
        {"loss": "own_l1"},
        {"optimiser": "own_adam"},
    ]


@pytest.mark.parametrize("name", list(SYSTEMS))
@pytest.mark.parametrize("given", [{"loss": charbonnier}, {"optimiser": sgd}])
def test_every_system_optimises_with_what_is_given(name, given):
    usual = mapped(name)
    own = mapped(name, **given)
    assert len(own.gaussians) > 0
    assert len(usual.gaussians) != len(own.gaussians) or not equal(usual, own)
    assert all(bool(x.isfinite().all()) for x in vars(own.gaussians.params).values())
    if "optimiser" in given and name == "gsfusion":  # plain gradient descent uses no moments
        assert not any(column.any() for column in vars(own.gaussians.moments.exp_avg).values())
    else:
        before = usual.training.names
        own_loss = own.training.names
        assert (before, list(own_loss)) == ({}, list(given))


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


@pytest.mark.parametrize(("name", "kind"), [("gsfusion", "loss"), ("rtg_slam", "optimiser")])
def test_what_fails_in_the_middle_of_a_frame_leaves_the_map_as_it_was(name, kind, same):
    """The third call in a frame fails; then the frame can be given again."""
    calls = [0]
    given = {"loss": charbonnier, "optimiser": sgd}[kind]

    def breaking(*args, **options):
        calls[0] += 1
        if calls[0] == 3:
            raise ArithmeticError("my function is broken")
        return given(*args, **options)

    config = SYSTEMS[name]
    own: dict[str, Any] = {kind: breaking}
    mapper = make_mapper(config, **own)
    for frame in open_sequence("room", n_frames=240, data=config.data).mapping:
        before = copy.deepcopy(maps_of(mapper))
        calls[0] = 0
        with contextlib.suppress(ArithmeticError):
            mapper.step(frame)
        if calls[0] == 3:
            break
    assert calls[0] == 3
    same(before, maps_of(mapper))
    mapper.step(frame)


def test_with_more_frames_the_passes_begin_again_and_an_undo_restores_all_counts():
    config = SYSTEMS["gsfusion"]
    frames = list(open_sequence("room", n_frames=240, data=config.data).mapping)
    mapper = make_mapper(config)
    for frame in frames[:3]:
        mapper.step(frame)
    next(mapper.global_optimise(1))
    assert mapper.passes.begun
    mapper.step(frames[3])
    assert not mapper.passes.begun

    def counts():
        return (
            mapper.lost.total,
            mapper.after_steps.n_steps,
            mapper.parts._steps_missed,
            len(mapper.keyframes),
        )

    before = counts()
    undo = mapper.transaction.snapshot()
    mapper.lost.total += 5
    mapper.after_steps.n_steps += 3
    mapper.parts._steps_missed = not mapper.parts._steps_missed
    mapper.keyframes.append(frames[4], with_depth=True)
    assert all(a != b for a, b in zip(before, counts(), strict=True))
    undo()
    assert counts() == before


def maps_of(mapper):
    """The state of a mapper but for the code of what was given, which counts its calls."""
    return {name: value for name, value in mapper.state_dict().items() if name != "training"}


def visits(
    passes: KeyframePasses, n: int, keyframes: int, generator, limit: int | None = None
) -> list[int]:
    seen: list[int] = []

    def optimise(i: int) -> torch.Tensor:
        seen.append(i)
        return torch.tensor(float(i))

    for _ in itertools.islice(passes.run(n, keyframes, generator, optimise), limit):
        pass
    return seen


def test_each_pass_visits_all_once_in_a_new_order(generator):
    passes = KeyframePasses()
    assert not passes.begun
    seen = visits(passes, 3, 10, generator)
    parts = [seen[k : k + 10] for k in (0, 10, 20)]
    assert [sorted(p) for p in parts] == [list(range(10))] * 3
    assert parts[0] != parts[1]
    assert (passes.done, passes.queue, passes.begun) == (3, [], True)


@pytest.mark.parametrize("stop", [1, 4, 5, 7])
def test_going_on_after_a_stop_is_the_same_as_no_stop(stop):
    whole = visits(KeyframePasses(), 2, 5, torch.Generator().manual_seed(3))
    generator = torch.Generator().manual_seed(3)
    passes = KeyframePasses()
    first = visits(passes, 2, 5, generator, stop)
    state = passes.state_dict()
    visits(passes, 1, 5, torch.Generator())  # what was saved stays as it was
    resumed = KeyframePasses()
    resumed.load_state_dict(state)
    assert resumed.begun
    left = 2 - resumed.done
    assert first + visits(resumed, left, 5, generator) == whole


def mapped_exposures(frames, **optim):
    config = gsfusion(
        "replica",
        tsdf__voxel_size_m=0.04,
        seeding__quadtree_threshold=0.03,
        seeding__quadtree_contrast="std",
        keyframe_every=1,
        optim__global_iterations=5,
        **{f"optim__{name}": value for name, value in optim.items()},
    )
    mapper = GSFusion(config)
    for frame in frames:
        mapper.step(frame)
    return mapper


@pytest.fixture(scope="module")
def flicker():
    """Eight frames close together; every second one is darker, most of all in blue."""
    sequence = room(n_frames=480, width=80, height=60)
    dark = torch.tensor([0.85, 0.8, 0.75])
    frames = [sequence[i] for i in range(8)]
    return dark, [dataclasses.replace(f, rgb=f.rgb * dark) if f.index % 2 else f for f in frames]


def test_relative_exposures_are_found_and_their_mean_is_one(flicker):
    dark, frames = flicker
    mapper = mapped_exposures(frames, fit_exposure=True)
    for _ in mapper.global_optimise():
        pass
    exposures = torch.stack([k.exposure for k in mapper.keyframes if k.exposure is not None])
    torch.testing.assert_close(
        exposures.log().mean(0),
        torch.zeros(3),
        atol=1e-6,
        rtol=0,
    )
    found = exposures[1::2].log().mean(0) - exposures[::2].log().mean(0)
    torch.testing.assert_close(found.exp(), dark, atol=0.03, rtol=0)


def test_a_resumed_run_goes_on_bit_for_bit_and_without_the_setting_nothing_is_fitted(flicker, same):
    _, frames = flicker
    whole = mapped_exposures(frames[:4], fit_exposure=True, refine_poses=True)
    passes = whole.global_optimise()
    for _ in range(6):
        next(passes)
    again = GSFusion.from_state_dict(copy.deepcopy(whole.state_dict()))
    for mapper in (whole, again):
        for _ in mapper.global_optimise(1):
            pass
    same(whole.state_dict(), again.state_dict())
    plain = mapped_exposures(frames[:2])
    next(plain.global_optimise())
    assert [k.exposure for k in plain.keyframes] == [None, None]


SMALL: dict[str, Any] = {
    "tsdf__voxel_size_m": 0.04,
    "seeding__quadtree_threshold": 0.03,
    "seeding__quadtree_contrast": "std",
    "keyframe_every": 1,
    "optim__global_iterations": 4,
}


@pytest.fixture(scope="module")
def walk():
    """Frames with poses that are off by 1 cm and 0.6 degrees about each axis, and the true
    poses."""
    sequence = room(n_frames=240, width=80, height=60)
    generator = torch.Generator().manual_seed(0)
    off = [se3.exp(0.01 * torch.randn(6, generator=generator)) for _ in range(12)]
    frames = [dataclasses.replace(sequence[i], T_WC=sequence.pose(i) @ off[i]) for i in range(12)]
    return [sequence.pose(i) for i in range(12)], frames


def mapped_poses(frames, refine, **settings):
    mapper = GSFusion(gsfusion("replica", optim__refine_poses=refine, **SMALL | settings))
    for frame in frames:
        mapper.step(frame)
    return mapper


def error(true, poses):
    """Mean error of the rotations, degrees; the map as a whole may be turned."""
    pairs = zip(true, poses, strict=True)
    omega = torch.stack([se3.log(b.double() @ se3.inverse(a.double()))[3:] for a, b in pairs])
    return float((omega - omega.mean(0)).norm(dim=1).mean().rad2deg())


def test_poses_come_closer_to_the_truth_and_the_given_ones_remain(walk):
    true, frames = walk
    mapper = mapped_poses(frames, True)
    for _ in mapper.global_optimise():
        pass
    given = [frame.T_WC for frame in frames]
    assert all(torch.equal(a, b) for a, b in zip(mapper.trajectory.given_poses, given, strict=True))
    assert error(true, mapper.trajectory.poses) < 0.9 * error(true, given)
    for keyframe in mapper.keyframes:
        row = mapper.trajectory.frame_indices.index(keyframe.index)
        assert torch.equal(keyframe.T_WC, mapper.trajectory.poses[row])


def test_a_resumed_run_has_the_same_poses_bit_for_bit(walk, same):
    _, frames = walk
    whole = mapped_poses(frames[:7], True)
    part = GSFusion.from_state_dict(copy.deepcopy(whole.state_dict()))
    for mapper in (whole, part):
        mapper.step(frames[7])
        passes = mapper.global_optimise()
        for _ in range(10):  # more than one pass over the 8 keyframes
            next(passes)
    again = GSFusion.from_state_dict(copy.deepcopy(part.state_dict()))
    for mapper in (whole, again):
        for _ in mapper.global_optimise(1):
            pass
    same(whole.state_dict(), again.state_dict())


def test_the_mean_motion_is_taken_back_from_map_and_keyframes(walk):
    _, frames = walk
    mapper = mapped_poses(frames[:4], True)
    G = se3.exp(torch.tensor([0.01, -0.02, 0.005, 0.01, 0.0, -0.01]))
    xyz_W = mapper.gaussians.params.xyz_W.clone()
    move_map_(mapper.gaussians, G.expand(len(xyz_W), 4, 4))
    mapper.keyframes.move(G.expand(len(mapper.keyframes), 4, 4))
    for k in mapper.keyframes:
        mapper.trajectory.refine(k.index, k.T_WC)
    assert mapper.fits is not None
    mapper.fits.end_pass(mapper.keyframes, mapper.gaussians)
    torch.testing.assert_close(mapper.gaussians.params.xyz_W, xyz_W, atol=1e-5, rtol=0)
    for k in mapper.keyframes:
        torch.testing.assert_close(
            k.T_WC,
            frames[k.index].T_WC,
            atol=1e-5,
            rtol=0,
        )


def keeps_its_own(param, gradient, m, v, steps, *, lr):
    param = param - lr * gradient


def divides_by_zero(param, gradient, m, v, steps, *, lr):
    param -= lr * gradient / m


def gives_back(param, gradient, m, v, steps, *, lr):
    param -= lr * gradient
    return param


@pytest.mark.parametrize(
    ("given", "error", "sentence"),
    [
        ({"loss": torch.nn.L1Loss}, TypeError, "loss must be a function, got .*L1Loss"),
        ({"optimiser": torch.optim.Adam}, TypeError, "optimiser must be a function, got .*Adam"),
        (
            {"optimiser": gives_back},
            TypeError,
            "'gives_back' must change param in place and return nothing, got",
        ),
        (
            {"optimiser": keeps_its_own},
            ValueError,
            r"'keeps_its_own' must change param in place \(param -= ",
        ),
        (
            {"optimiser": divides_by_zero},
            ValueError,
            "'divides_by_zero' makes NaN or infinity from a gradient of 1",
        ),
    ],
)
def test_functions_that_cannot_train_are_refused(given, error, sentence):
    with pytest.raises(error, match=sentence):
        Training(**given)


PICTURE = RenderOutput(
    rgb=torch.zeros(2, 3, 3),
    depth_m=torch.ones(2, 3),
    alpha=torch.ones(2, 3),
    first_index=None,
    dominant_index=None,
)


@pytest.mark.parametrize(
    ("returned", "error", "sentence"),
    [
        (0.5, TypeError, r"loss 'own' must return a ViewLoss \(gsfusion_nb.optim\), got 0.5"),
        ({"value": torch.zeros(1)}, ValueError, r"value of the loss 'own' must be \[\], got \[1\]"),
        (
            {"v_rgb": torch.zeros(3, 2, 3)},
            ValueError,
            r"v_rgb of the loss 'own' must be \[2, 3, 3\], got \[3, 2, 3\]",
        ),
        (
            {"v_rgb": torch.full((2, 3, 3), torch.nan)},
            ValueError,
            "v_rgb of the loss 'own' must be finite, got 18 NaN",
        ),
        (
            {"v_depth_m": torch.full((2, 3), torch.inf)},
            ValueError,
            "v_depth_m of the loss 'own' must be finite",
        ),
        (
            {"v_depth_m": torch.zeros(2, 3)},
            ValueError,
            "'own' returned v_depth_m, but this system's depth has no",
        ),
    ],
)
def test_what_a_loss_must_return(returned, error, sentence):
    def own(rendered, view):
        if not isinstance(returned, dict):
            return returned
        found = ViewLoss(
            value=torch.zeros(()),
            v_rgb=torch.zeros(2, 3, 3),
        )
        for (
            name,
            value,
        ) in returned.items():  # past the type check of ViewLoss, which is off outside the tests
            object.__setattr__(found, name, value)
        return found

    view = TrainingView(
        rgb=torch.zeros(2, 3, 3),
        depth_m=torch.zeros(2, 3),
        camera=Camera(width=3, height=2, fx=1.0, fy=1.0, cx=1.5, cy=1.0),
        T_WC=torch.eye(4),
        pixels=torch.ones(2, 3, dtype=torch.bool),
    )
    with pytest.raises(error, match=sentence):
        Training(own).view_loss(PICTURE, view, with_geometry=False)
