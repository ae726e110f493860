"""Maps of which a view shows a part: rows that lie out of view for long, and the steps that they
miss."""

import copy
import dataclasses
import importlib
from typing import Any, ClassVar

import pytest
import torch

from gsfusion_nb.config import replace
from gsfusion_nb.data import apply_options
from gsfusion_nb.export import read_gaussian_ply
from gsfusion_nb.large_maps import MapParts
from gsfusion_nb.large_maps import boxes as row_boxes
from gsfusion_nb.mapping import SYSTEMS, make_mapper
from gsfusion_nb.mapping.lost_rows import finite_rows
from gsfusion_nb.optim import take_missed_steps
from gsfusion_nb.runs import MappingRun, run_mapping
from gsfusion_nb.runs.outputs import write_maps
from gsfusion_nb.runs.scores import score
from gsfusion_nb.seeding import Edit, MapRule, map_params

APART_M = 25.0
"""From one place to the next: no camera sees two of them."""

QUICK = {
    "gsfusion": {
        "tsdf__voxel_size_m": 0.08,
        "optim__random_keyframe_iterations": 1,
        "optim__global_iterations": 1,
    },
    "rtg_slam": {
        "window__every_frames": 2,
        "window__iterations": 4,
        "keyframes__iterations": 2,
        "final__passes": 1,
    },
    "gps_slam": {
        "tsdf__voxel_size_m": 0.08,
        "schedule__every_frames": 2,
        "schedule__iterations": 4,
        "final__passes": 2,
    },
}
"""Short rounds; the rule of ``settings`` is asked in every frame, so a few frames hold several
rounds."""


HERE_ONLY = {
    "gsfusion": {"optim__random_keyframe_iterations": 0},
    "rtg_slam": {},
    "gps_slam": {"schedule__keyframes": 0, "schedule__window_every": 1},
}
"""No step on a view of a place that the camera has left."""


@pytest.fixture(autouse=True)
def _small_maps_in_parts(monkeypatch):
    monkeypatch.setattr(row_boxes, "WHOLE_BELOW", 0)


def settings(system, fidelity, **changes):
    base = SYSTEMS[system].preset("room", fidelity)
    more = {
        "seeding__rule": "uniform",
        "seeding__options": {"fraction": 0.1, "coverage": False},
        "tracking__pose_jumps": "map",
    }
    return replace(base, **{**QUICK[system], **more, **changes})


def walk(frames, places, n):
    """``n`` frames in each of the places, one after the other, in the order of time."""
    index = 0
    for place in places:
        for frame in frames[:n]:
            T_WC = frame.T_WC.clone()
            T_WC[0, 3] += APART_M * place
            yield dataclasses.replace(frame, T_WC=T_WC, index=index, timestamp_s=float(index))
            index += 1


class TwoPlaces:
    """A sequence whose first three frames are in one place and the others in another."""

    def __init__(self, sequence):
        self.name, self.camera, self._sequence = sequence.name, sequence.camera, sequence

    def __len__(self):
        return len(self._sequence)

    def pose(self, i):
        T_WC = self._sequence.pose(i).clone()
        T_WC[0, 3] += APART_M * (i >= 3)
        return T_WC

    def __getitem__(self, i):
        return dataclasses.replace(self._sequence[i], T_WC=self.pose(i))


def mapped(config, room, places=(0, 1, 0), n=4):
    mapper = make_mapper(config)
    frames = [room[i] for i in range(n)]
    for frame in walk(frames, places, n):
        mapper.step(frame)
        mapper.gaussians.clock.check()
    return mapper


def missing(mapper):
    return int(mapper.gaussians.clock.steps_missed.sum())


FOLLOWED = [
    (name, fidelity)
    for name, system in SYSTEMS.items()
    for fidelity in system.description.fidelities
]


@pytest.mark.parametrize(("system", "fidelity"), FOLLOWED)
def test_rows_that_lie_out_of_view_for_long_stay_finite(system, fidelity, small_room):
    mapper = mapped(settings(system, fidelity, **HERE_ONLY[system]), small_room)
    list(mapper.global_optimise(1))
    assert mapper.lost.total == 0
    assert len(mapper.gaussians) > 100
    assert bool(finite_rows(mapper.gaussians.params).all())
    assert missing(mapper) == 0


@pytest.mark.slow
@pytest.mark.parametrize(("system", "fidelity"), FOLLOWED)
def test_a_long_walk_through_three_places_stays_finite(system, fidelity, small_room):
    """With the steps of the fidelity and the system's own rule; 10 frames are a round of
    GPS-SLAM."""
    coarse = {"tsdf__voxel_size_m": 0.04} if hasattr(SYSTEMS[system].config_type(), "tsdf") else {}
    config = replace(SYSTEMS[system].preset("room", fidelity), **coarse, tracking__pose_jumps="map")
    mapper = mapped(
        config,
        small_room,
        places=(0, 1, 2, 1, 2, 0, 1),
        n=12,
    )
    assert mapper.lost.total == 0
    assert bool(finite_rows(mapper.gaussians.params).all())


@pytest.fixture
def half_stepped(small_room):
    """Of each system with Adam on rows of the map: a map of two places, of which the first misses
    steps."""

    def make(system):
        mapper = mapped(
            settings(system, "measured", **HERE_ONLY[system]),
            small_room,
            (0, 1),
        )
        assert missing(mapper) > 0
        finished = copy.deepcopy(mapper.gaussians)
        take_missed_steps(finished, mapper.row_optim)
        assert not torch.equal(finished.params.xyz_W, mapper.gaussians.params.xyz_W)
        return mapper, finished

    return make


@pytest.mark.parametrize("system", ["gsfusion", "gps_slam"])
def test_what_is_shown_written_or_given_to_a_rule_has_the_missed_steps(
    system, half_stepped, small_room, same
):
    mapper, finished = half_stepped(system)
    before = mapper.state_dict()
    frame = next(walk([small_room[0]], [0], 1))
    whole = make_mapper(mapper.config)
    whole._load(copy.deepcopy(before))
    whole.parts.take_missed_steps()
    assert missing(whole) == 0
    for name, column in vars(finished.params).items():
        assert torch.equal(mapper.files.maps()["gaussians"][name], column)
        assert torch.equal(getattr(map_params(mapper.seed_context(frame)), name), column)
        shown = getattr(mapper.files.standard_gaussians(), name)
        assert torch.equal(shown, getattr(whole.files.standard_gaussians(), name))
    context = mapper.seed_context(frame)
    assert torch.equal(context.map.xyz_W, finished.params.xyz_W)
    for seen in ("rgb", "alpha"):
        a, b = (getattr(m.render(frame.camera, frame.T_WC), seen) for m in (mapper, whole))
        torch.testing.assert_close(a, b, atol=2e-5, rtol=0)
        a, b = (getattr(m.seed_context(frame).render(), seen) for m in (mapper, whole))
        torch.testing.assert_close(a, b, atol=2e-5, rtol=0)
    same(mapper.state_dict()["gaussians"], before["gaussians"])  # who looks does not change the map


@pytest.mark.parametrize("system", ["gsfusion", "gps_slam"])
def test_the_passes_begin_and_end_without_missed_steps(system, half_stepped):
    mapper, finished = half_stepped(system)
    list(mapper.global_optimise(0))
    assert missing(mapper) == 0
    for name, column in vars(finished.params).items():
        assert torch.equal(getattr(mapper.gaussians.params, name), column)
    list(mapper.global_optimise(1))
    assert missing(mapper) == 0


@pytest.mark.parametrize("system", SYSTEMS)
def test_the_files_of_a_run_hold_the_map_without_missed_steps(system, tmp_path):
    config = settings(system, "measured", data__stop=6, data__width=0, data__height=0)
    room: dict[str, Any] = {"n_frames": 60, "width": 64, "height": 48}
    run = run_mapping("room", config=config, folder=tmp_path / "run", evaluate=False, **room)
    stored = read_gaussian_ply(tmp_path / "run/gaussians.ply")
    mapper = run.mapper
    assert run.metrics["n_not_finite"] == 0
    assert missing(mapper) == 0
    for name in ("xyz_W", "log_scale", "opacity_logit"):
        torch.testing.assert_close(
            getattr(stored, name),
            getattr(mapper.gaussians.params, name),
            atol=1e-6,
            rtol=1e-6,
        )
    if system == "rtg_slam":
        assert int(mapper.disc_passes.optimiser.copies.clock.steps_missed.sum()) == 0


@pytest.mark.parametrize("system", ["gsfusion", "gps_slam"])
def test_what_is_written_or_scored_before_the_passes_has_the_missed_steps(
    system, small_room, tmp_path
):
    data = {"width": 0, "height": 0, "stop": 6, "hold_out_every": 3, "hold_out_offset": 1}
    config = settings(system, "measured", **HERE_ONLY[system], data=data)
    run = MappingRun(apply_options(TwoPlaces(small_room), config.data), make_mapper(config))
    list(run.online())
    assert missing(run.mapper) > 0
    (tmp_path / "maps").mkdir()
    write_maps(run, tmp_path / "maps")
    stored = read_gaussian_ply(tmp_path / "maps/gaussians.ply")
    scores = score(run)
    assert missing(run.mapper) > 0
    before = run.mapper.gaussians.params.xyz_W.clone()
    run.mapper.parts.take_missed_steps()
    finished = run.mapper.gaussians.params
    assert not torch.equal(finished.xyz_W, before)
    for name in ("xyz_W", "log_scale", "opacity_logit"):
        torch.testing.assert_close(
            getattr(stored, name), getattr(finished, name), atol=1e-6, rtol=1e-6
        )
    assert scores["psnr_held_out_db"] == pytest.approx(score(run)["psnr_held_out_db"], abs=1e-4)


def test_discs_have_their_missed_steps_between_two_passes(small_room):
    """RTG-SLAM's passes step the discs in view; the others catch up when they are drawn or
    written."""
    mapper = mapped(settings("rtg_slam", "code"), small_room, (0, 1))
    steps = mapper.global_optimise(2)
    next(steps)
    mapper.disc_passes.optimiser.copies.clock.check()
    assert int(mapper.disc_passes.optimiser.copies.clock.steps_missed.sum()) > 0
    now = mapper.parts.params_now()
    stored = mapper.gaussians.params
    up_to_date = copy.deepcopy(mapper.disc_passes.optimiser)
    up_to_date.take_missed_steps()
    assert len(up_to_date.copies) == len(stored)
    for name, column in vars(up_to_date.trained_params).items():
        assert torch.equal(getattr(now, name), column)
    list(steps)
    assert int(mapper.disc_passes.optimiser.copies.clock.steps_missed.sum()) == 0
    for name, column in vars(mapper.disc_passes.optimiser.trained_params).items():
        assert torch.equal(getattr(mapper.gaussians.params, name), column)


@pytest.mark.parametrize(
    ("system", "fidelity"),
    [("gsfusion", "code"), ("gps_slam", "code"), ("gps_slam", "paper")],
)
def test_three_places_by_view_are_those_of_the_whole_map(system, fidelity, small_room, monkeypatch):
    maps = []
    shares = []
    in_view = MapParts.in_view

    def watched(parts, *args):
        part = in_view(parts, *args)
        shares.append(len(part.params) / len(part.model))
        return part

    monkeypatch.setattr(MapParts, "in_view", watched)
    monkeypatch.setattr(row_boxes, "MOSTLY_SEEN", 2.0)
    for whole_below in (10**9, 0):
        monkeypatch.setattr(row_boxes, "WHOLE_BELOW", whole_below)
        shares.clear()
        mapper = mapped(
            settings(system, fidelity, **HERE_ONLY[system]),
            small_room,
            (0, 1, 2, 0),
        )
        assert mapper.config.all_in_view
        assert (min(shares) < 0.6) == (whole_below == 0)
        maps.append(mapper)
    assert len(maps[0].gaussians) == len(maps[1].gaussians)
    whole, by_view = (mapper.parts.params_now() for mapper in maps)
    # Adam makes the sign of a gradient of nearly 0 a whole step
    for name, column in vars(whole).items():
        assert float((column - getattr(by_view, name)).abs().mean()) < 1e-5, name
    for frame in walk([small_room[1]], (0, 1, 2), 1):
        pictures = [mapper.render(frame.camera, frame.T_WC).rgb for mapper in maps]
        assert float((pictures[0] - pictures[1]).abs().mean()) < 1e-4


ONE_PASS = {"gps_slam": {"final__passes": 1, "schedule__every_frames": 1}}
"""A round in every frame, and a pass also where none is published."""

VJPS = {
    "gsfusion": "gsfusion_nb.mapping.gsfusion.render_vjp",
    "rtg_slam": "gsfusion_nb.mapping.surfel_optimiser.render_vjp",
    "gps_slam": "gsfusion_nb.mapping.gps_views.render_over_base_vjp",
}
"""Where each system gets its gradients from."""


def break_gradients(monkeypatch, system, columns):
    """Make the gradients of two rows NaN in these columns whenever the list that is returned holds
    something."""
    module, name = VJPS[system].rsplit(".", 1)
    usual = getattr(importlib.import_module(module), name)
    broken = []

    def vjp(*args, **kwargs):
        g = usual(*args, **kwargs)
        if broken:
            for column in columns:
                getattr(g, column)[:2] = torch.nan
        return g

    monkeypatch.setattr(VJPS[system], vjp)
    return broken


@pytest.mark.parametrize(
    ("system", "fidelity"), [*((name, "measured") for name in SYSTEMS), ("gps_slam", "code")]
)
@pytest.mark.parametrize("columns", [("sh",), ("log_scale", "opacity_logit")])
def test_gaussians_that_become_nan_are_counted_and_said_once(
    system, fidelity, columns, small_room, monkeypatch
):
    """Also those that the rules for removal would remove: no limit holds for what is NaN."""
    broken = break_gradients(monkeypatch, system, columns)
    mapper = make_mapper(settings(system, fidelity, **ONE_PASS.get(system, {})))
    told = []
    counted = []
    for frame in walk(
        [small_room[i] for i in range(6)],
        [0],
        6,
    ):
        broken[:] = [1] if frame.index in (3, 5) else []
        report = mapper.step(frame)
        counted.append(report.n_not_finite)
        told += mapper.reports.step_warnings(frame, report)
        assert bool(finite_rows(mapper.gaussians.params).all())
    assert [n > 0 for n in counted] == [False] * 3 + [True, False, True]
    said = [sentence for sentence in told if "NaN" in sentence]
    assert len(said) == 1
    assert said[0].startswith(
        f"frame 3: {counted[3]} Gaussians became NaN or infinite in gradient steps and were"
    )
    assert mapper.lost.total == sum(counted)
    again = type(mapper).from_state_dict(mapper.state_dict())
    assert again.lost.total == sum(counted)
    broken[:] = [1]
    run = MappingRun(apply_options(small_room, mapper.config.data), mapper)
    list(run.optimise())
    assert mapper.lost.total > sum(counted)
    assert [w.partition(":")[0] for w in run.warnings if "NaN" in w] == [
        "pass 1 over the keyframes"
    ]
    assert bool(finite_rows(mapper.gaussians.params).all())


@dataclasses.dataclass(frozen=True, kw_only=True)
class Prunes(MapRule):
    """Removes transparent Gaussians after each step, as many published rules do."""

    needs: ClassVar[frozenset[str]] = frozenset({"image_gradients", "abs_image_gradients"})

    def seeds(self, ctx, memory):
        return ctx.seeds_at(ctx.pixels()[::7], 1.0)

    def after_step(self, ctx, stats: Any, memory):
        of_rows = (stats.visible, stats.radius_px, stats.v_uv, stats.v_uv_abs)
        assert {len(values) for values in of_rows} == {len(ctx.map)}
        assert bool(finite_rows(ctx.gaussians.params).all())
        return Edit(keep=ctx.map.opacity >= 0.0)


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_rule_that_edits_removes_no_lost_gaussian_without_a_word(system, small_room, monkeypatch):
    """No comparison holds for NaN, so a rule that keeps what is opaque removes what was lost."""
    broken = break_gradients(monkeypatch, system, ("opacity_logit",))
    mapper = make_mapper(settings(system, "measured"), seeding=Prunes)
    for i in range(6):
        broken[:] = [1] if i in (3, 5) else []
        before = len(mapper.gaussians)
        report = mapper.step(small_room[i])
        gone = before + report.n_seeds - len(mapper.gaussians)
        assert report.n_not_finite >= 2 * bool(broken)
        assert system == "rtg_slam" or gone == report.n_not_finite
    total = mapper.lost.total
    broken[:] = [1]
    list(mapper.global_optimise(1))
    assert mapper.lost.total > total
