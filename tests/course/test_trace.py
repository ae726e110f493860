"""A trace of a mapper: its numbers are those of the operations, and the map is that of a mapper
without a trace."""

import dataclasses
import itertools
import math
from dataclasses import dataclass

import pytest
import torch

from gsfusion_nb import GSFusion, gsfusion, rtg_slam
from gsfusion_nb.backends import use_backend
from gsfusion_nb.course.trace import Trace, tracing
from gsfusion_nb.course.trace.operations import tensors_of
from gsfusion_nb.gaussians import Edit
from gsfusion_nb.large_maps import boxes as row_boxes
from gsfusion_nb.large_maps import chunks
from gsfusion_nb.mapping import RTGSLAM
from gsfusion_nb.optim import adam_update
from gsfusion_nb.seeding import MapRule
from gsfusion_nb.types import Camera, Frame

SMALL = {"data__width": 32, "data__height": 24}


def settings(**changes):
    usual = {
        "tsdf__voxel_size_m": 0.08,
        "sh_degree": 1,
        "keyframe_min_seeds": 20,
        "seeding__quadtree_contrast": "std",
    }
    return gsfusion("room", "paper_steps", **(SMALL | usual | changes))


@pytest.fixture(scope="module")
def frames():
    """A camera that slides along a wall with stripes, half of them nearer."""
    camera = Camera(
        width=32,
        height=24,
        fx=28.0,
        fy=28.0,
        cx=16.0,
        cy=12.0,
    )
    v, u = torch.meshgrid(
        torch.arange(24) + 0.5,
        torch.arange(32) + 0.5,
        indexing="ij",
    )
    out = []
    for i in range(5):
        x = (u - 16) / 28 * 2 + 0.15 * i
        stripe = 0.5 + 0.4 * torch.sin(2 * math.pi * x / 0.8)
        rgb = torch.stack([stripe, 1 - stripe, 0.3 + 0.4 * v / 24], -1)
        T = torch.eye(4)
        T[0, 3] = 0.15 * i
        depth_m = torch.where(stripe > 0.5, 1.9, 2.0)
        out.append(
            Frame(
                index=2 * i,
                timestamp_s=0.1 * i,
                rgb=rgb,
                depth_m=depth_m,
                camera=camera,
                T_WC=T,
            )
        )
    return out


@pytest.fixture(scope="module")
def traced(frames):
    """(mapper, its trace, an equal mapper without a trace), after four frames and a pass over the
    keyframes."""
    mapper = GSFusion(settings())
    plain = GSFusion(settings())
    trace = Trace(mapper)
    for frame in frames[:4]:
        mapper.step(frame)
        plain.step(frame)
    for m in (mapper, plain):
        list(m.global_optimise(1))
    return mapper, trace, plain


def assert_same(a, b):
    for name, tensors in a.files.maps().items():
        for column, value in tensors.items():
            assert torch.equal(value, b.files.maps()[name][column]), (name, column)


def test_no_number_of_the_map_changes(traced):
    mapper, _, plain = traced
    assert_same(mapper, plain)
    saved = mapper.gaussians.state_dict()["rows"]
    other = plain.gaussians.state_dict()["rows"]
    assert saved.keys() == other.keys()
    assert all(torch.equal(saved[name], other[name]) for name in other)


def parts_of_a_step(trace, serial):
    """What each Gaussian adds to the picture of a step: number -> (weight [H, W], colour), and that
    picture."""
    parts = {}
    image = None
    for i in range(trace.identities.count):
        for step in (s for s in trace.gaussian(id=i).steps if s.serial == serial):
            weight = torch.zeros(24, 32)
            image = step.image
            for tile in step.tiles:
                x, y, w, h = tile.box
                u, v = tile.pixels.unbind(1)
                assert ((u >= x) & (u < x + w) & (v >= y) & (v < y + h)).all()
                torch.testing.assert_close(tile.weight, tile.alpha * tile.transmittance)
                weight[v, u] = tile.weight
            parts[i] = weight, step.rgb
    return parts, image


@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_the_weights_of_all_gaussians_make_the_picture_and_a_click_finds_the_largest(
    frames, backend
):
    mapper = GSFusion(settings())
    with use_backend(backend), tracing(mapper) as trace:
        mapper.step(frames[0])
    last = trace.gaussian(id=0).steps[-1].serial
    parts, image = parts_of_a_step(trace, last)
    torch.testing.assert_close(
        sum(w[..., None] * c for w, c in parts.values()),
        image,
        atol=1e-5,
        rtol=0,
    )
    ids = list(parts)
    weights = torch.stack([w for w, _ in parts.values()])
    for u, v in ((3, 4), (16, 12), (31, 23)):
        assert (
            trace.gaussian_at(u, v)
            == trace.gaussian_at(u, v, last)
            == ids[int(weights[:, v, u].argmax())]
        )


def test_adam_gives_the_next_value(traced):
    mapper, trace, _ = traced
    optim = mapper.config.optim
    steps = trace.gaussian(3).steps
    assert {step.stage for step in steps} >= {"frame", "passes"}
    for i, step in enumerate(steps):
        assert set(step.adam) == {"xyz_W", "log_scale", "quat", "opacity_logit", "sh"}
        for name, a in step.adam.items():
            p = a.before[None].clone()
            m = a.m[0][None].clone()
            v = a.v[0][None].clone()
            gradient = a.gradient[None]
            adam_update(
                p,
                gradient,
                m,
                v,
                step.t,
                lr=a.lr,
                beta1=optim.beta1,
                beta2=optim.beta2,
                eps=optim.eps,
            )
            torch.testing.assert_close(p[0], a.after, atol=1e-7, rtol=1e-6)
            torch.testing.assert_close(m[0], a.m[1])
            torch.testing.assert_close(v[0], a.v[1])
            if i + 1 < len(steps):
                assert torch.equal(steps[i + 1].adam[name].before, a.after)
    last = steps[-1].adam
    assert torch.equal(last["xyz_W"].after, mapper.gaussians.params.xyz_W[3])
    assert torch.equal(last["sh"].m[1], mapper.gaussians.moments.exp_avg.sh[3])


def test_the_gradient_is_that_of_the_mapper(frames):
    mapper = GSFusion(settings())
    seen = []
    trace = Trace(mapper)
    from gsfusion_nb.optim import view_step as module

    usual = module.adam_step

    def noted(model, gradients, *rest):
        seen.append({name: value.clone() for name, value in vars(gradients).items()})
        usual(model, gradients, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "adam_step", noted)
        mapper.step(frames[0])
    steps = trace.gaussian(5).steps
    assert len(steps) == len(seen) > 0
    for step, gradients in zip(steps, seen, strict=True):
        for name, a in step.adam.items():
            assert torch.equal(a.gradient, gradients[name][5])


def test_steps_on_a_part_of_a_large_map_are_recorded(frames, monkeypatch):
    monkeypatch.setattr(row_boxes, "WHOLE_BELOW", 0)
    monkeypatch.setattr(chunks, "CHUNK", 16)
    turned = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    mapper = GSFusion(settings())
    with tracing(mapper) as trace:
        mapper.step(frames[0])
        mapper.step(dataclasses.replace(frames[1], T_WC=turned))
    steps = [trace.gaussian(row).steps for row in range(len(mapper.gaussians))]
    for row, (*_, last) in enumerate(steps):
        assert last.row == row
        assert torch.equal(last.adam["xyz_W"].after, mapper.gaussians.params.xyz_W[row])
    serials = [{step.serial for step in of_row} for of_row in steps]
    assert set.union(*serials) > serials[0]
    assert set.union(*serials) > serials[-1]


def test_a_voxel_has_the_values_of_the_volume(frames):
    mapper = GSFusion(settings())
    trace = Trace(mapper)
    for frame in frames[:3]:
        mapper.step(frame)
    x, y, z = trace.voxel_at(16, 12, serial=0)
    assert abs(trace.voxel(x, y, z).moments[0].z_m - float(frames[0].depth_m[12, 16])) < 0.08
    for k in range(-2, 3):
        moments = trace.voxel(x, y, z + k).moments
        assert [m.frame_index for m in moments] == [f.index for f in frames[:3]]
        centre = (torch.tensor([[x, y, z + k]]) + 0.5) * mapper.config.tsdf.voxel_size_m
        now = mapper.volume.sample_nearest(centre)
        assert (moments[-1].D[1], moments[-1].W[1]) == (float(now.D), float(now.W))
        for before, after in itertools.pairwise(moments):
            assert (before.D[1], before.W[1]) == (after.D[0], after.W[0])
        for m in (m for m in moments if m.observed):
            d = max(-1.0, min(1.0, m.sdf_m / mapper.config.tsdf.truncation_m))
            assert m.W[1] == m.W[0] + 1
            assert m.D[1] == pytest.approx(
                (m.D[0] * m.W[0] + d) / m.W[1],
                abs=1e-4,
            )


def test_the_birth_of_a_gaussian_is_its_cell(traced, frames):
    mapper, trace, _ = traced
    born = trace.gaussian(0).birth
    assert (born.cause, born.frame_index, born.rule) == ("seed", frames[0].index, "gsfusion")
    x, y, w, h, level = born.cell
    assert born.uv == pytest.approx((x + w / 2, y + h / 2), abs=1e-3)
    assert level == born.tag == int(mapper.gaussians.tag[0])
    seeded = trace.gaussian(0).moments[0]
    assert seeded.boxes == {
        "cell": [(x, y, w, h)],
        "pixel": [(int(born.uv[0]), int(born.uv[1]), 1, 1)],
    }
    assert seeded.image is frames[0].colour


def test_memory_stays_within_the_limit_and_what_was_picked_stays(frames, traced):
    whole = traced[1]
    mapper = GSFusion(settings())
    trace = Trace(mapper, memory_bytes=100_000)
    voxel = whole.voxel_at(16, 12, serial=0)
    trace.voxel(*voxel)
    for frame in frames[:4]:
        mapper.step(frame)
        newest = max(
            sum(t.untyped_storage().nbytes() for t in tensors_of([r])) for r in trace._held
        )
        assert trace.memory_bytes <= max(100_000, newest)
        trace.gaussian(id=2)  # picked after the first frame
    assert trace.n_dropped > 10
    kept = trace.voxel(*voxel).moments
    every = whole.voxel(*voxel).moments
    assert [(m.serial, m.D, m.W) for m in kept] == [(m.serial, m.D, m.W) for m in every]
    assert kept[0].image is None
    kept, every = ([s for s in t.gaussian(id=2).steps if s.frame_index] for t in (trace, whole))
    assert [s.serial for s in kept] == [s.serial for s in every]
    for a, b in zip(kept, every, strict=True):
        assert torch.equal(a.adam["xyz_W"].after, b.adam["xyz_W"].after)
        assert a.weight == b.weight
    assert "no longer held" in str(trace.gaussian(id=2))
    assert trace.gaussian(id=2).birth.cell == whole.gaussian(id=2).birth.cell


@dataclass(frozen=True, kw_only=True)
class Reshaping(MapRule):
    """Removes, splits, clones and relocates rows, each once."""

    def seeds(self, ctx, memory):
        return ctx.cells() if ctx.frame_number == 0 else ctx.cells()[:0]

    def after_step(self, ctx, stats, memory):
        n = len(ctx.gaussians.params)
        memory["step"] = step = int(memory.get("step", 0)) + 1
        keep = torch.ones(n, dtype=torch.bool)
        keep[0] = False
        edits = {
            2: Edit(keep=keep),
            3: Edit(split=torch.tensor([4])),
            4: Edit(clone=torch.tensor([5])),
            5: Edit(relocate=(torch.tensor([1]), torch.tensor([7]))),
        }
        return edits.get(step)


def test_identity_is_followed_through_edits(frames):
    mapper = GSFusion(settings(), seeding=Reshaping)
    trace = Trace(mapper)
    mapper.step(frames[0])
    mapper.step(frames[1])
    n = trace.gaussian(id=0).birth
    assert n.frame_index == frames[0].index
    first = trace.gaussian(id=0)
    assert first.row is None
    assert len(first.steps) == 2
    assert first.events[-1].what == "removed by the rule"
    halves = [
        i for i in range(trace.identities.count) if trace.identities.birth(i).cause == "split"
    ]
    assert [trace.identities.birth(i).parent for i in halves] == [
        5,
        5,
    ]  # row 4 after row 0 was removed
    assert trace.gaussian(id=5).row is None
    assert trace.gaussian(id=5).events[-1].what == "split in two"
    copy = next(
        i for i in range(trace.identities.count) if trace.identities.birth(i).cause == "clone"
    )
    assert trace.identities.birth(copy).parent is not None
    assert any(e.what.startswith("relocated") for e in trace.identities.events)
    for row in range(len(mapper.gaussians)):
        steps = trace.gaussian(row).steps
        assert torch.equal(
            steps[-1].adam["xyz_W"].after,
            mapper.gaussians.params.xyz_W[row],
        )
        assert "split" in str(trace.gaussian(id=5))


def test_a_traced_mapper_is_saved_and_resumed_without_its_trace(frames):
    mapper = GSFusion(settings())
    plain = GSFusion(settings())
    trace = Trace(mapper)
    for m in (mapper, plain):
        m.step(frames[0])
    resumed = GSFusion.from_state_dict(mapper.state_dict())
    again = Trace(resumed)
    for m in (mapper, plain, resumed):
        m.step(frames[1])
    assert_same(mapper, plain)
    assert_same(resumed, plain)
    born = again.gaussian(id=0).birth
    assert (born.cause, born.frame_index) == ("before the trace", frames[0].index)
    assert len(trace.gaussian(0).steps) > len(again.gaussian(0).steps) > 0


def test_after_closing_nothing_is_recorded(frames):
    mapper = GSFusion(settings())
    with tracing(mapper) as trace:
        mapper.step(frames[0])
    n = len(trace.gaussian(0).steps)
    mapper.step(frames[1])
    assert len(trace.gaussian(0).steps) == n > 0
    assert not any(name.startswith("trace.") for name in mapper.gaussians.columns)
    Trace(mapper)
    with pytest.raises(ValueError, match="traced already"):
        Trace(mapper)


def test_wrong_questions_are_refused(traced):
    _, trace, _ = traced
    with pytest.raises(IndexError, match="row must be between"):
        trace.gaussian(10**6)
    with pytest.raises(IndexError, match="no Gaussian has the number"):
        trace.gaussian(id=10**6)
    with pytest.raises(ValueError, match="either the row"):
        trace.gaussian()
    with pytest.raises(ValueError, match="no Gaussian is known"):
        trace.gaussian_at(32, 0)
    with pytest.raises(ValueError, match="no voxel is known"):
        trace.voxel_at(0, 24)


def test_every_moment_has_a_text_and_a_line_of_code(traced):
    _, trace, _ = traced
    voxel = trace.voxel(*trace.voxel_at(16, 12))
    for moment in [*trace.gaussian(3).moments, *voxel.moments]:
        place, code = moment.source_line()
        assert place.startswith("gsfusion_nb/")
        assert code in str(moment)
    assert str(trace.gaussian(3)).count("\n") > 10
    assert "W after" in str(voxel)


def test_of_another_system_seeds_are_recorded(frames):
    mapper = RTGSLAM(rtg_slam("room", **SMALL))
    with tracing(mapper) as trace:
        mapper.step(frames[0])
    assert trace.gaussian(0).birth.cause == "seed"
    assert not trace.gaussian(0).steps
