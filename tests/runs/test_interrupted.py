"""Ctrl-C at any place, as in a notebook, and then the same call again: the maps have the same
bits."""

import contextlib
import itertools
import random
import signal
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from gsfusion_nb import gaussians, interrupts, optim
from gsfusion_nb.backends import dispatch
from gsfusion_nb.config import gps_slam, replace, rtg_slam
from gsfusion_nb.config import gsfusion as gsfusion_settings
from gsfusion_nb.data import apply_options
from gsfusion_nb.large_maps import MapPart
from gsfusion_nb.large_maps import boxes as row_boxes
from gsfusion_nb.mapping import gsfusion, keyframe_fits, make_mapper, surfel_optimiser
from gsfusion_nb.runs import MappingRun, run_mapping
from gsfusion_nb.runs.map_hashes import map_hashes
from gsfusion_nb.seeding import frame_queries

PACKAGE = Path(interrupts.__file__).parent
WATCHED = tuple(
    str(PACKAGE / name) for name in ("mapping", "runs", "optim", "gaussians", "interrupts.py")
)
VARIANTS = [
    "gsfusion",
    "gsfusion_fits",
    pytest.param("rtg_slam", marks=pytest.mark.ci),
    "gps_slam",
]


def settings(variant: str, config: Any) -> Any:
    """Few frames of a system; "gsfusion_fits" also moves keyframes and fits their exposure."""
    if variant == "gsfusion_fits":
        fits = {"refine_poses": True, "fit_exposure": True}
        return replace(config, optim=fits, data__stop=9)
    if variant == "gsfusion":
        return replace(config, data__stop=9, tracking__poses="tracked", tracking__back_end=False)
    data = {"width": 0, "height": 0, "hold_out_every": 4, "hold_out_offset": 2, "stop": 9}
    if variant == "gps_slam":
        schedule = {"every_frames": 2, "window_every": 2, "iterations": 4}
        extra = {
            "final__passes": 2,
            "tsdf__voxel_size_m": 0.04,
            "seeding__rule": "uniform",
            "seeding__options": {},
        }
        return gps_slam("room", data=data, schedule=schedule, **extra)
    return rtg_slam(
        "room", data=data, final__passes=2, window__every_frames=2, tracking__poses="tracked"
    )


def new_run(variant: str, config: Any, room: Any) -> MappingRun:
    config = settings(variant, config)
    return MappingRun(apply_options(room, config.data), make_mapper(config))


@contextlib.contextmanager
def ctrl_c_at(place: int):
    """Ctrl-C at the ``place``-th line, call or return of the package's code; yields a list with the
    number of those."""
    seen = [0]

    def traced(frame: Any, event: str, _: Any) -> Any:
        if not frame.f_code.co_filename.startswith(WATCHED):
            return None
        seen[0] += 1
        if seen[0] == place:
            signal.raise_signal(signal.SIGINT)
        return traced

    before = sys.gettrace()
    sys.settrace(traced)
    try:
        yield seen
    finally:
        sys.settrace(before)


@pytest.fixture(scope="module")
def whole(config, small_room):
    """``whole(variant)``: hashes of a run that nobody interrupted, and its number of events online
    and in passes."""
    done: dict[str, Any] = {}

    def of(variant: str) -> Any:
        if variant not in done:
            warm = new_run(variant, config, small_room)  # no event is that of a compiler
            list(warm.online())
            list(warm.optimise())
            run = new_run(variant, config, small_room)
            with ctrl_c_at(-1) as online:
                list(run.online())
            with ctrl_c_at(-1) as passes:
                list(run.optimise())
            done[variant] = map_hashes(run), online[0], passes[0], list(run.global_passes.losses)
        return done[variant]

    return of


def is_quiet() -> bool:
    """Whether nothing of the delay of signals is left."""
    handler = signal.getsignal(signal.SIGINT)
    return interrupts.DelayedInterrupt._outermost is None and handler is signal.default_int_handler


@pytest.mark.parametrize("variant", VARIANTS)
def test_passes_that_are_interrupted_anywhere_and_called_again_end_in_the_same_map(
    variant, whole, config, small_room
):
    hashes, _, n_events, losses = whole(variant)
    run = new_run(variant, config, small_room)
    draw = random.Random(variant)
    n_interrupts = 0
    list(run.online())
    n_keyframes = len(run.mapper.keyframes)
    assert n_keyframes > 1
    while not run.global_passes.is_finished:
        try:
            with ctrl_c_at(draw.randint(1, n_events // (3 * n_keyframes))):
                for _ in run.optimise():
                    pass
        except KeyboardInterrupt:
            n_interrupts += 1
        assert is_quiet()
    assert n_interrupts >= n_keyframes
    assert map_hashes(run) == hashes
    assert run.global_passes.losses == losses


@pytest.mark.parametrize("variant", VARIANTS)
def test_mapping_that_is_interrupted_anywhere_and_called_again_ends_in_the_same_map(
    variant, whole, config, small_room
):
    hashes, n_events, _, _ = whole(variant)
    run = new_run(variant, config, small_room)
    draw = random.Random(variant)
    n_interrupts = 0
    for attempt in itertools.count(1):
        undisturbed = attempt % 8 == 0
        place = -1 if undisturbed else draw.randint(1, n_events // 7)
        try:
            with ctrl_c_at(place):
                for _ in run.online():
                    if undisturbed:
                        break
                else:
                    break
        except KeyboardInterrupt:
            n_interrupts += 1
        assert is_quiet()
        assert run.mapper.guard.half_mapped == ""
    assert n_interrupts > 5
    list(run.optimise())
    assert map_hashes(run) == hashes


PLACES = {
    "gsfusion": [
        (gsfusion, "render_forward"),
        (gsfusion, "render_vjp"),
        (optim.view_step, "adam_step"),
    ],
    "gps_slam": [
        (MapPart, "write_back"),
        (gaussians.StepClock, "write_back"),
        (optim.map_step, "adam_update_map"),
    ],
    "rtg_slam": [
        (optim.view_step, "adam_step"),
        (surfel_optimiser, "take_missed_steps"),
        (gaussians.StepClock, "step"),
    ],
    "gsfusion_fits": [
        (keyframe_fits.KeyframeFits, "move"),
        (keyframe_fits, "move_map_"),
        (keyframe_fits, "fit_exposure"),
    ],
}


@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_a_step_after_the_scan_that_fails_in_any_operation_can_be_repeated(
    variant, when, whole, config, small_room, monkeypatch
):
    """Whatever raises, such as a full memory: what the step has done by then is undone."""
    monkeypatch.setattr(row_boxes, "WHOLE_BELOW", 0)
    monkeypatch.setattr(row_boxes, "MOSTLY_SEEN", 2.0)
    run, still = (new_run(variant, config, small_room) for _ in range(2))
    for each in (run, still):
        list(each.online())
    list(still.optimise())
    for owner, name in PLACES[variant]:
        f = getattr(owner, name)
        calls = [0]

        def failing(*args: Any, f=f, calls=calls, **options: Any) -> Any:
            calls[0] += 1
            fails = calls[0] % 3 == 0
            if fails and when == "before":
                raise MemoryError("no room")
            result = f(*args, **options)
            if fails:
                raise MemoryError("no room")
            return result

        with monkeypatch.context() as patch:
            patch.setattr(owner, name, failing)
            n_failed = 0
            for _ in range(4):
                try:
                    next(iter(run.optimise()), None)
                except MemoryError:
                    n_failed += 1
            assert n_failed or run.global_passes.is_finished, name
    list(run.optimise())
    assert map_hashes(run) == map_hashes(still)


def test_ctrl_c_while_a_kernel_is_compiled_ends_the_first_frame_as_if_it_had_not_begun(
    config, small_room, whole
):
    """At any place of it, also after the Gaussians were changed and while the depth is fused."""
    for name in ("quadtree", "render_forward", "fuse_frame_"):
        run = new_run("gsfusion_fits", config, small_room)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                gsfusion if hasattr(gsfusion, name) else frame_queries, name, compiled_in(name)
            )
            with pytest.raises(KeyboardInterrupt):
                list(run.online())
        assert is_quiet()
        assert (run.mapper.n_frames, len(run.mapper.gaussians), run.mapper.volume.n_blocks) == (
            0,
            0,
            0,
        )
        list(run.online())
        list(run.optimise())
        assert map_hashes(run) == whole("gsfusion_fits")[0], name


def compiled_in(name: str) -> Any:
    """The operation, which is pressed Ctrl-C in while it is compiled."""
    f = getattr(gsfusion if hasattr(gsfusion, name) else frame_queries, name)

    def compiling(*args: Any, **options: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        interrupts.compiler_goes_on()
        return f(*args, **options)

    return compiling


def test_a_stop_is_heard_while_kernels_of_the_first_frame_are_compiled(tmp_path, monkeypatch):
    """The command line turns Ctrl-C into a wish to stop; then there is nothing to save."""
    monkeypatch.setattr(gsfusion, "render_forward", compiled_in("render_forward"))
    data = {"data__stop": 3, "tsdf__voxel_size_m": 0.1}
    with pytest.raises(KeyboardInterrupt):
        run_mapping(
            "room",
            gsfusion_settings("room", **data),
            folder=tmp_path / "out",
            n_frames=120,
            width=32,
            height=24,
        )
    assert is_quiet()
    assert {p.name for p in (tmp_path / "out").iterdir()} <= {".lock"}


def test_what_hides_a_keyboard_interrupt_becomes_one(monkeypatch):
    """Python says SystemError where a signal arrives in compiled code that is about to return."""

    def hiding(*_: Any) -> Any:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as e:
            raise SystemError("returned a result with an exception set") from e

    def broken(*_: Any) -> Any:
        raise SystemError("broken")

    picture = torch.rand(16, 16, 3)
    monkeypatch.setattr(dispatch, "load", lambda *_: hiding)
    with pytest.raises(KeyboardInterrupt):
        optim.l1_mse_vjp(picture, picture)
    monkeypatch.setattr(dispatch, "load", lambda *_: broken)
    with pytest.raises(SystemError, match="broken"):
        optim.l1_mse_vjp(picture, picture)
