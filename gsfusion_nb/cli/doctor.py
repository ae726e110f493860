"""``gsfusion-nb doctor``: what is installed, what works, and what to do where it does not;
``--warm`` compiles.

``warm`` compiles every fast kernel once, so that no notebook waits for it later: each system maps a
few frames of the built-in room. Compiled code is kept on disk. What is compiled depends on the
types of the arguments, not on their size, so small pictures are enough.
"""

import contextlib
import dataclasses
import importlib.metadata
import logging
import os
import platform
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import torch

from .. import __version__, backends
from ..config import DataConfig, SystemConfig, gps_slam, gsfusion, rtg_slam
from ..data import open_sequence
from ..large_maps import boxes
from ..mapping import make_mapper
from ..optim import ColumnRates
from ..optim.missed_steps import MissedSteps, missed_steps_map
from ..progress import ProgressDisplay
from ..types import GaussianParams

PACKAGES = (
    "torch",
    "numpy",
    "numba",
    "opencv-python-headless",
    "kornia",
    "matplotlib",
    "jupyterlab",
    "ipykernel",
    "ipywidgets",
    "jupyterlab-widgets",
    "anywidget",
    "plyfile",
    "pyvista",
    "scipy",
    "scikit-posthocs",
    "tyro",
)

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


@dataclass(frozen=True, kw_only=True)
class DoctorOptions:
    """Show what is installed, what works, and what to do where something does not."""

    warm: bool = False
    """Only compile the fast kernels, so that later commands start faster."""


def run(options: DoctorOptions) -> int:
    """The command."""
    return warm() if options.warm else main()


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
        f"{len(missing)} problem(s) to solve: see the arrows above."
        if missing
        else "Everything needed is installed."
    )
    return 1 if missing else 0


def warm() -> int:
    """Compile the fast kernels once and show for what. Returns 0, or 1 if no fast kernel can run
    here.

    Uses what ``auto`` would choose, and leaves out what is not installed. On one thread: more of
    them gain nothing on so little data, and wait for each other on a busy machine.
    """
    from ..compare.bench.timing import threads

    if all(backends.automatic(name, "cpu") == "reference" for name in backends.operations()):
        print(
            "No fast kernels can run here, so there is nothing to compile; gsfusion-nb doctor "
            "shows why."
        )
        return 1
    print(
        "Compiling the fast kernels once, so that programs and notebooks start faster (about a "
        "minute) ..."
    )
    start = time.perf_counter()
    todo = _examples()
    with (
        ProgressDisplay("compiling", total=len(todo), unit="map") as display,
        backends.use_backend("auto"),
        _quietly(),
        threads(1),
    ):
        for position, config in enumerate(todo):
            display.show(position, note=type(config).__name__)
            _map(config)
        _take_missed_steps()
        display.show(len(todo))
    print(
        f"All fast kernels are compiled and stored on disk ({time.perf_counter() - start:.0f} s)."
    )
    return 0


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _python() -> EnvironmentCheck:
    text = (
        f"{platform.python_version()} on {platform.system()} {platform.machine()}, "
        f"{os.cpu_count()} cores"
    )
    return EnvironmentCheck(
        "python", sys.version_info >= (3, 11), text, "gsfusion_nb needs Python 3.11 or newer"
    )


def _package(name: str, remedy: str, *, needed: bool = True) -> EnvironmentCheck:
    version = _version(name)
    return EnvironmentCheck(name, version is not None, version or "not installed", remedy, needed)


def _opencv_twins() -> EnvironmentCheck:
    twins = [
        n
        for n in ("opencv-python", "opencv-contrib-python", "opencv-contrib-python-headless")
        if _version(n)
    ]
    text = f"{', '.join(twins)} and opencv-python-headless" if twins else "one copy"
    return EnvironmentCheck(
        "opencv copies",
        not twins,
        text,
        f"they overwrite each other's files: pip uninstall {' '.join(twins)}",
    )


def _torch() -> list[EnvironmentCheck]:
    layer, _ = backends.kernel_threads()
    n = torch.get_num_threads()
    threads = EnvironmentCheck(
        "threads",
        layer == "tbb",
        f"{n} for computing; those of the numba kernels are from {layer}",
        "a map takes up to 1.6 times as long without: pip install tbb",
        needed=False,
    )
    cuda = torch.cuda.is_available()
    text = torch.cuda.get_device_name(0) if cuda else "none; everything runs on the CPU"
    return [threads, EnvironmentCheck("CUDA device", cuda, text, needed=False)]


def _backends() -> list[EnvironmentCheck]:
    from .. import optim, render, seeding, tracking, tsdf  # noqa: F401  (importing them declares their operations)

    checks = [EnvironmentCheck("backends", True, f"chosen: {backends.from_environment()}")]
    for name, backend, state in backends.report():
        checks.append(
            EnvironmentCheck(
                f"  {name} / {backend}", state == "ok", state, needed=backend == "reference"
            )
        )
    return checks


def _drawing() -> EnvironmentCheck:
    from ..viz.meshes import can_draw

    ok, why = can_draw()
    remedy = "until this works, notebooks and reports have no pictures of meshes"
    return EnvironmentCheck("VTK drawing", ok, why, remedy, needed=False)


def _examples() -> list[SystemConfig]:
    """Settings that together use every operation; the rule asks for gradients of centres in the
    image."""
    coarse = {"voxel_size_m": 0.05}
    tracking = {"poses": "tracked", "landmarks": True, "back_end": True}
    rules = [
        {"rule": "default_strategy", "options": {"absgrad": absolute}} for absolute in (False, True)
    ]
    return [
        *(gsfusion("room", tsdf=coarse, seeding=rule) for rule in rules),
        gsfusion("room", tsdf=coarse, tracking=tracking),
        rtg_slam("room", tracking=tracking, window={"iterations": 2, "every_frames": 2}),
        gps_slam("room", tsdf=coarse, schedule__every_frames=2),
        gps_slam("room", tsdf=coarse, schedule__every_frames=2, seeding=rules[1]),
    ]


def _map(config: SystemConfig) -> None:
    """Map five frames, the last three as a large map: colours from 8 bits and between them, and a
    jump after which the camera is sought again."""
    room = open_sequence(
        "room", data=DataConfig(width=320, height=240, hold_out_every=0), n_frames=600
    ).mapping
    mapper = make_mapper(config)
    for index, position in enumerate((0, 1, 2, 40, 41)):
        frame = dataclasses.replace(room[position], index=index, timestamp_s=float(index))
        with _in_parts() if index > 1 else contextlib.nullcontext():
            mapper.step(dataclasses.replace(frame, rgb=frame.rgb) if index == 2 else frame)
    with _in_parts():
        for _ in mapper.global_optimise(1):
            pass
    for camera in (
        frame.camera,
        frame.camera.resized(24, 18),
    ):  # rays look up voxels in another way if they are few
        mapper.render(camera, frame.T_WC)
    if not mapper.description.gaussians_are_discs:
        mapper.mesh()


def _take_missed_steps() -> None:
    """Steps that rows of a large map missed; in one of five frames every row takes part in each."""
    rows, m, v = (
        GaussianParams(
            xyz_W=torch.zeros(2, 3),
            log_scale=torch.zeros(2, 3),
            quat=torch.ones(2, 4),
            opacity_logit=torch.zeros(2),
            sh=torch.zeros(2, 16, 3),
        )
        for _ in range(3)
    )
    steps = MissedSteps(torch.ones(2, dtype=torch.int32), None, 0.9, 0.999, 1e-15)
    rates = ColumnRates(
        xyz_W=0.0, log_scale=0.0, quat=0.0, opacity_logit=0.0, sh_dc=0.0, sh_rest=0.0
    )
    decays = (steps.distance, steps.decay1, steps.decay2)
    missed_steps_map(rows, m, v, *decays, rates=rates, eps=1e-15)


@contextlib.contextmanager
def _in_parts() -> Iterator[None]:
    """A map is drawn and stepped by part, as a large one."""
    whole_below = boxes.WHOLE_BELOW
    boxes.WHOLE_BELOW = 0
    try:
        yield
    finally:
        boxes.WHOLE_BELOW = whole_below


def map_examples(configs: Iterable[SystemConfig]) -> None:
    """Compile what systems with these settings need, without a message."""
    with _quietly():
        _take_missed_steps()
        for config in configs:
            _map(config)


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """No message that kernels are being compiled, which was asked for here, or that a case is a
    difficult map."""
    logger = logging.getLogger("gsfusion_nb")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
