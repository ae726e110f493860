"""``gsfusion-nb doctor``: what is installed, what works, and what to do where it does not; ``--warm`` compiles.

``warm`` compiles every fast kernel once, so that no notebook waits for it later: each operation runs on a handful of
values. Compiled code is kept on disk. What is compiled depends on the types of the arguments, not on their size, so a
picture of 64 x 48 pixels is enough.
"""

import contextlib
import dataclasses
import functools
import importlib.metadata
import logging
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch

from .. import __version__, backends
from ..config import SystemConfig, gps_slam, gsfusion, rtg_slam
from ..mapping import make_mapper
from ..types import Camera, Frame
from ..work import ProgressDisplay

PACKAGES = (
    "torch", "numpy", "numba", "opencv-python-headless", "kornia", "matplotlib", "jupyterlab",
    "ipykernel", "ipywidgets", "jupyterlab-widgets", "anywidget", "plyfile", "pyvista", "scipy", "tyro",
)  # fmt: skip

OPTIONAL = {
    "triton": "some of the kernels for GPUs: pip install 'gsfusion-nb[gpu]'",
    "lpips": "LPIPS metric: pip install 'gsfusion-nb[lpips]'",
}


@dataclass(frozen=True)
class EnvironmentCheck:
    """One line of the examination."""

    topic: str
    ok: bool
    text: str
    remedy: str = ""
    needed: bool = True
    """Whether the toolkit cannot be used without it."""


def examine() -> list[EnvironmentCheck]:
    """Examine this Python environment and machine; nothing is changed."""
    return [
        _python(),
        *(_package(name, f"pip install {name}") for name in PACKAGES),
        *(_package(name, remedy, needed=False) for name, remedy in OPTIONAL.items()),
        _opencv_twins(),
        *_torch(),
        *_backends(),
        _drawing(),
    ]


def main() -> int:
    """Print the checks. Returns 0 if nothing needed is missing, else 1."""
    checks = examine()
    print(f"gsfusion_nb {__version__} in {sys.prefix}")
    width = max(len(f.topic) for f in checks)
    for f in checks:
        mark = "ok" if f.ok else "NO" if f.needed else "--"
        print(f"  {mark}  {f.topic:<{width}}  {f.text}")
        if f.remedy and not f.ok:
            print(f"      {'':<{width}}  -> {f.remedy}")
    missing = [f for f in checks if not f.ok and f.needed]
    print(
        f"{len(missing)} problem(s) to solve: see the arrows above." if missing else "Everything needed is installed."
    )
    return 1 if missing else 0


def warm() -> int:
    """Compile the fast kernels once and show which. Returns 0, or 1 if no fast kernel can run here.

    Uses what ``auto`` would choose, and leaves out what is not installed. On one thread: on so little data more gain
    nothing, and on a busy machine they wait for each other.
    """
    from ..compare.bench.timing import threads

    print("Compiling the fast kernels once, so that programs and notebooks start faster (about a minute) ...")
    todo, start = compiled_cases(), time.perf_counter()
    if not todo:
        print("No fast kernels can run here, so there is nothing to compile; gsfusion-nb doctor shows why.")
        return 1
    with (
        ProgressDisplay("compiling", total=len(todo), unit="case") as display,
        backends.use_backend("auto"), _quietly(), threads(1),
    ):  # fmt: skip
        for done, case in enumerate(todo):
            display.show(done, note=case.name)
            case.run()
        display.show(len(todo))
    print(f"All fast kernels are compiled and stored on disk ({time.perf_counter() - start:.0f} s).")
    return 0


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _python() -> EnvironmentCheck:
    text = f"{platform.python_version()} on {platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    return EnvironmentCheck("python", sys.version_info >= (3, 11), text, "gsfusion_nb needs Python 3.11 or newer")


def _package(name: str, remedy: str, *, needed: bool = True) -> EnvironmentCheck:
    version = _version(name)
    return EnvironmentCheck(name, version is not None, version or "not installed", remedy, needed)


def _opencv_twins() -> EnvironmentCheck:
    twins = [n for n in ("opencv-python", "opencv-contrib-python", "opencv-contrib-python-headless") if _version(n)]
    text = f"{', '.join(twins)} and opencv-python-headless" if twins else "one copy"
    return EnvironmentCheck(
        "opencv copies", not twins, text, f"they overwrite each other's files: pip uninstall {' '.join(twins)}"
    )


def _torch() -> list[EnvironmentCheck]:
    (layer, _), n = backends.kernel_threads(), torch.get_num_threads()
    threads = EnvironmentCheck(
        "threads", layer == "tbb", f"{n} for computing; those of the numba kernels are from {layer}",
        "a map takes up to 1.6 times as long without: pip install tbb", needed=False,
    )  # fmt: skip
    cuda = torch.cuda.is_available()
    text = torch.cuda.get_device_name(0) if cuda else "none; everything runs on the CPU"
    return [threads, EnvironmentCheck("CUDA device", cuda, text, needed=False)]


def _backends() -> list[EnvironmentCheck]:
    from .. import optim, render, seeding, tracking, tsdf  # noqa: F401  (importing them declares their operations)

    checks = [EnvironmentCheck("backends", True, f"chosen: {backends.from_environment()}")]
    for name, backend, state in backends.report():
        checks.append(EnvironmentCheck(f"  {name} / {backend}", state == "ok", state, needed=backend == "reference"))
    return checks


def _drawing() -> EnvironmentCheck:
    from ..viz.meshes import can_draw

    ok, why = can_draw()
    remedy = "until this works, notebooks and reports have no pictures of meshes"
    return EnvironmentCheck("VTK drawing", ok, why, remedy, needed=False)


_WIDTH, _HEIGHT = 64, 48


@dataclass(frozen=True)
class WarmUpCase:
    """A piece of work that makes its operations' kernels compile."""

    name: str
    operations: tuple[str, ...]
    run: Callable[[], object]


def compiled_cases(device: str = "cpu") -> list[WarmUpCase]:
    """The cases of which ``auto`` takes compiled kernels."""
    return [case for case in warm_up_cases(device) if any(_is_compiled(name, device) for name in case.operations)]


def warm_up_cases(device: str = "cpu") -> Iterator[WarmUpCase]:
    """One for each case of an operation's folder, and the mappers of the systems at the end."""
    for case in backends.cases():
        if torch.float32 in case.dtypes:
            run = functools.partial(case.run, torch.device(device), torch.float32)
            yield WarmUpCase(f"{' and '.join(case.operations)}: {case.name}", case.operations, run)
    frames = [_frame(device, whole_numbers=n) for n in (True, False)]
    tsdf = {"voxel_size_m": 0.05, "truncation_voxels": 2.0}
    configs = (
        gsfusion("replica", tsdf=tsdf, seeding={"quadtree_threshold": 1e-3}, keyframe_min_seeds=1),
        rtg_slam("replica", tracking__poses="tracked", window__iterations=2, window__every_frames=3),
        gps_slam("replica", tsdf__voxel_size_m=0.05, schedule__every_frames=2),
    )
    for config in configs:
        run = functools.partial(_map, config, frames, device)
        yield WarmUpCase(f"whole mapper: {type(config).__name__}", backends.operations(), run)


def _map(config: SystemConfig, frames: list[Frame], device: str) -> None:
    mapper = make_mapper(config, device=device)
    for index in range(3):
        mapper.step(dataclasses.replace(frames[index % 2], index=index, timestamp_s=float(index)))
    for _ in mapper.global_optimise(1):
        pass
    mapper.render(frames[0].camera, frames[0].T_WC)
    if not mapper.gaussians_are_discs:
        mapper.mesh()


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
    return backends.automatic(operation, device) != "reference"


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """No message that kernels are being compiled, which was asked for here, or that a case is a difficult map."""
    logger = logging.getLogger("gsfusion_nb")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)
