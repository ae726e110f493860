"""Compile every fast kernel once, so that no notebook waits for it later: each operation runs on a handful of values.

Compiled code is kept on disk. What is compiled depends on the types of the arguments, not on their size, so a picture
of 64 x 48 pixels is enough.
"""

import contextlib
import dataclasses
import functools
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch

from . import backends
from .config import SeedingConfig, TsdfConfig, gps_slam, gsfusion, rtg_slam
from .mapping import GPSSLAM, RTGSLAM, GSFusion
from .processes import run_in_processes, usable_cores
from .types import Camera, Frame

_WIDTH, _HEIGHT = 64, 48
MOST_PROCESSES = 8
"""More would hardly be faster: the slowest case takes an eighth of the whole."""


@dataclass(frozen=True)
class WarmUpCase:
    """A piece of work that makes its operations' kernels compile."""

    name: str
    operations: tuple[str, ...]
    run: Callable[[], object]


@dataclass(frozen=True, kw_only=True)
class WarmUpProgress:
    """Where ``warm_up`` stands before and after each case."""

    name: str
    """What runs next; empty at the end."""
    done: int
    total: int
    compiled: tuple[str, ...]
    """Kernels that had to be compiled so far; the others came from the cache."""
    seconds: float


def warm_up(device: str = "cpu", *, processes: int = 0) -> Iterator[WarmUpProgress]:
    """Run the cases of all operations that have compiled kernels on ``device``, reporting before each.

    A generator, so that the caller draws the progress. Uses what ``auto`` would choose, and leaves out what is not
    installed. On the processor, as soon as something has to be compiled, the rest is shared out to several processes;
    whatever they did not compile is compiled here in the end.

    Args:
        device: Where the tensors of the cases are.
        processes: How many processes compile; 0: as many as there are cores, ``MOST_PROCESSES`` at most.
    """
    todo = _todo(device)
    start, done = time.perf_counter(), 0
    processes = processes or min(usable_cores(), MOST_PROCESSES)
    with _as_a_worker() as compiled:
        while done < len(todo):
            yield _progress(todo[done].name, done, len(todo), compiled, start)
            todo[done].run()
            done += 1
            if compiled and device == "cpu" and processes > 1 and len(todo) - done > 1:
                break
        rest = todo[done:]
        needs = [frozenset(e.operations) for e in rest]
        for i, names in run_in_processes(_compile, [(device, e.name) for e in rest], needs, processes):
            compiled += names or ()
            done += 1
            yield _progress(f"after {rest[i].name}", done - 1, len(todo), compiled, start)
        for case in rest:  # from the cache
            case.run()
        yield _progress("", len(todo), len(todo), compiled, start)


def _todo(device: str) -> list[WarmUpCase]:
    return [e for e in warm_up_cases(device) if any(_is_compiled(operation, device) for operation in e.operations)]


@functools.cache
def _by_name(device: str) -> dict[str, WarmUpCase]:
    return {case.name: case for case in _todo(device)}


def _compile(device: str, name: str) -> list[str]:
    """Run one case in its own process; returns what was compiled."""
    with _as_a_worker() as compiled:
        _by_name(device)[name].run()
        return list(compiled)


@contextlib.contextmanager
def _as_a_worker() -> Iterator[list[str]]:
    """The fastest backends, no notices, one thread; names of what is compiled meanwhile."""
    with backends.use_backend("auto"), _quietly(), _one_thread(), _watching() as compiled:
        yield compiled


def warm_up_cases(device: str = "cpu") -> Iterator[WarmUpCase]:
    """One for each case of an operation's folder, and the mappers of the systems at the end."""
    for case in backends.cases():
        if torch.float32 in case.dtypes:
            run = _once(case.run, torch.device(device), torch.float32)
            yield WarmUpCase(f"{' and '.join(case.operations)}: {case.name}", case.operations, run)
    frame, grey = (_frame(device, whole_numbers=n) for n in (True, False))
    yield WarmUpCase("whole mapper: GSFusion", backends.operations(), _once(_map, frame, grey, device))
    yield WarmUpCase("whole mapper: RTG-SLAM", backends.operations(), _once(_slam, frame, grey, device))
    yield WarmUpCase("whole mapper: GPS-SLAM", backends.operations(), _once(_over_tsdf, frame, grey, device))


def _once(function: Callable, *args, **kwargs) -> Callable[[], object]:
    return lambda: function(*args, **kwargs)


def _map(frame: Frame, grey: Frame, device: str) -> None:
    config = gsfusion(
        "replica",
        tsdf=vars(TsdfConfig(voxel_size_m=0.05, truncation_voxels=2.0)),
        seeding=vars(SeedingConfig(quadtree_threshold=1e-3)),
        keyframe_min_seeds=1,
    )
    mapper = GSFusion(config, device=device)
    for picture in (frame, grey):
        mapper.step(picture)
    for _ in mapper.global_optimise(1):
        pass
    mapper.render(frame.camera, frame.T_WC)
    mapper.mesh()


def _slam(frame: Frame, grey: Frame, device: str) -> None:
    config = rtg_slam("replica", tracking__poses="tracked", window__iterations=2, final__passes=1)
    mapper = RTGSLAM(config, device=device)
    for index in range(config.window.every_frames):
        mapper.step(dataclasses.replace((frame, grey)[index % 2], index=index, timestamp_s=float(index)))
    for _ in mapper.global_optimise():
        pass
    mapper.render(frame.camera, frame.T_WC)


def _over_tsdf(frame: Frame, grey: Frame, device: str) -> None:
    config = gps_slam("replica", tsdf__voxel_size_m=0.05, schedule__every_frames=2, final__passes=1)
    mapper = GPSSLAM(config, device=device)
    for index in range(3):
        mapper.step(dataclasses.replace((frame, grey)[index % 2], index=index, timestamp_s=float(index)))
    for _ in mapper.global_optimise():
        pass
    mapper.render(frame.camera, frame.T_WC)


def _frame(device: str, *, whole_numbers: bool) -> Frame:
    """A checked, slanted wall 1.5 m away; colours as from 8 bits, or between them."""
    v, u = torch.meshgrid(torch.arange(_HEIGHT), torch.arange(_WIDTH), indexing="ij")
    levels = torch.stack([(u // 7 + v // 5) % 2 * 200, u * 3, v * 4], dim=-1)
    rgb = levels.byte() if whole_numbers else (levels + 0.4) / 255
    camera = Camera(width=_WIDTH, height=_HEIGHT, fx=50.0, fy=50.0, cx=_WIDTH / 2, cy=_HEIGHT / 2)
    depth_m = 1.5 + 0.004 * u.float()
    frame = Frame(index=0, timestamp_s=0.0, rgb=rgb, depth_m=depth_m, camera=camera, T_WC=torch.eye(4))
    return frame.to(device)


def _is_compiled(operation: str, device: str) -> bool:
    """Whether ``auto`` takes compiled kernels for it. Operations are declared where their references are imported."""
    return backends.automatic(operation, device) not in ("reference", "torch")


def _progress(name: str, done: int, total: int, compiled: list[str], start: float) -> WarmUpProgress:
    seconds = time.perf_counter() - start
    return WarmUpProgress(name=name, done=done, total=total, compiled=tuple(compiled), seconds=seconds)


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """No message from the kernels that they are being compiled: here that is what was asked for."""
    logger = logging.getLogger("gsfusion_nb.kernels")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """On so little data threads gain nothing, and on a busy machine they wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def _watching() -> Iterator[list[str]]:
    """Names of our functions that numba compiles inside the block, as they come."""
    try:
        from numba.core import event
    except ImportError:
        yield []
        return
    names: list[str] = []

    class Listener(event.Listener):
        def on_start(self, event):
            function = event.data["dispatcher"].py_func
            if function.__module__.startswith(f"{__package__}.kernels"):
                names.append(f"{function.__module__.split('.')[-2]}.{function.__name__}")

        def on_end(self, event):
            pass

    with event.install_listener("numba:compile", Listener()):
        yield names
