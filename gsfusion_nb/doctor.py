"""``gsfusion-nb doctor``: what is installed, what works, and what to do where it does not; ``--warm`` compiles."""

import importlib.metadata
import os
import platform
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from . import __version__, backends

PACKAGES = (
    "torch", "numpy", "numba", "opencv-python-headless", "kornia", "matplotlib", "jupyterlab",
    "ipykernel", "ipywidgets", "jupyterlab-widgets", "anywidget", "plyfile", "pyvista", "scipy", "tyro",
)  # fmt: skip

OPTIONAL = {
    "triton": "some of the kernels for GPUs: pip install 'gsfusion-nb[gpu]'",
    "gtsam": "RTG-SLAM back end: pip install 'gsfusion-nb[slam]'",
    "rerun-sdk": "recordings for the Rerun viewer: pip install 'gsfusion-nb[rerun]'",
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
        *(_package(name) for name in PACKAGES),
        *(_optional(name, remedy) for name, remedy in OPTIONAL.items()),
        _opencv_twins(),
        *_torch(),
        *_backends(),
        _drawing(),
        _disk(),
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
    """Compile the fast kernels once and show which. Returns 0, or 1 if no fast kernel can run here."""
    from .progress import ProgressDisplay
    from .warm import warm_up

    print("Compiling the fast kernels once, so that programs and notebooks start faster (about a minute) ...")
    progress = None
    with ProgressDisplay("compiling", unit="case") as display:
        for progress in warm_up():
            display.show(progress.done, total=progress.total, note=progress.name)
    if progress is None or not progress.total:
        print("No fast kernels can run here, so there is nothing to compile; gsfusion-nb doctor shows why.")
        return 1
    n = len(progress.compiled)
    print(
        f"{n} functions compiled in {progress.seconds:.0f} s and stored on disk."
        if n
        else f"Everything was compiled already and was read from disk in {progress.seconds:.1f} s."
    )
    return 0


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _python() -> EnvironmentCheck:
    text = f"{platform.python_version()} on {platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    return EnvironmentCheck("python", sys.version_info >= (3, 11), text, "gsfusion_nb needs Python 3.11 or newer")


def _package(name: str) -> EnvironmentCheck:
    version = _version(name)
    return EnvironmentCheck(name, version is not None, version or "not installed", f"pip install {name}")


def _optional(name: str, remedy: str) -> EnvironmentCheck:
    version = _version(name)
    return EnvironmentCheck(name, version is not None, version or "not installed", remedy, needed=False)


def _opencv_twins() -> EnvironmentCheck:
    twins = [n for n in ("opencv-python", "opencv-contrib-python", "opencv-contrib-python-headless") if _version(n)]
    text = f"{', '.join(twins)} and opencv-python-headless" if twins else "one copy"
    return EnvironmentCheck(
        "opencv copies", not twins, text, f"they overwrite each other's files: pip uninstall {' '.join(twins)}"
    )


def _torch() -> list[EnvironmentCheck]:
    import torch

    (layer, _), n = backends.kernel_threads(), torch.get_num_threads()
    threads = EnvironmentCheck(
        "threads", layer == "tbb", f"{n} for computing; those of the numba kernels are from {layer}",
        "a map takes up to 1.6 times as long without: pip install tbb", needed=False,
    )  # fmt: skip
    cuda = torch.cuda.is_available()
    text = torch.cuda.get_device_name(0) if cuda else "none; everything runs on the CPU"
    return [threads, EnvironmentCheck("CUDA device", cuda, text, needed=False)]


def _backends() -> list[EnvironmentCheck]:
    from . import optim, render, seeding, tracking, tsdf  # noqa: F401  (importing them declares their operations)

    checks = [EnvironmentCheck("backends", True, f"chosen: {backends.from_environment()}")]
    for name, backend, state in backends.report():
        checks.append(EnvironmentCheck(f"  {name} / {backend}", state == "ok", state, needed=backend == "reference"))
    return checks


def _drawing() -> EnvironmentCheck:
    from .viz.meshes.picture import can_draw

    ok, why = can_draw()
    remedy = "until this works, notebooks and reports have no pictures of meshes"
    return EnvironmentCheck("VTK drawing", ok, why, remedy, needed=False)


def _disk() -> EnvironmentCheck:
    free = shutil.disk_usage(Path.cwd()).free / 1e9
    return EnvironmentCheck("disk", free > 2, f"{free:.0f} GB free here", "a run with its checkpoint takes up to 1 GB")
