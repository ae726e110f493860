"""The roofline of this machine (Williams, Waterman & Patterson 2009), and where this package's
kernels are below it.

    attainable flop/s = min(peak flop/s, intensity x bandwidth),   intensity = flop / bytes moved
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from ..backends import BACKENDS, report, use_backend
from ..drawing.curves import PALETTE
from ..errors import ArgumentError
from .bench.options import DEVICES
from .bench.timing import describe, header, lap, threads
from .kernel_work import Work, mapping_work

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class Roofs:
    """Measured limits of one core, or of a GPU."""

    gflops: float
    """10^9 float32 operations per second: a matrix product."""
    gb_per_s: float
    """10^9 bytes per second to and from memory: b = a + b, in place, on arrays larger than the
    caches."""

    @property
    def ridge(self) -> float:
        """Intensity (flop per byte) at which the roofs meet."""
        return self.gflops / self.gb_per_s

    def attainable_gflops(self, intensity: float | int) -> float:
        """The limit for a kernel of this intensity."""
        return min(self.gflops, intensity * self.gb_per_s)


@dataclass(frozen=True, kw_only=True)
class KernelPoint:
    """One operation on one backend, timed on one thread or on a GPU."""

    name: str
    backend: str
    flops: float | int
    bytes: float | int
    seconds: float

    @property
    def intensity(self) -> float:
        """Flop per byte."""
        return self.flops / self.bytes

    @property
    def gflops(self) -> float:
        """Measured speed."""
        return self.flops / self.seconds / 1e9


def fastest_s(
    work: Callable[[], object],
    *,
    repeats: int = 5,
    device: str = "cpu",
) -> float:
    """CPU time of the fastest of ``repeats`` runs, which other programs affect least, after one run
    that compiles and fills caches. On "cuda" the time between two events of its queue."""
    work()
    laps = [lap(work, device) for _ in range(repeats)]
    return max(
        min(x.cpu_s if x.device_s is None else x.device_s for x in laps),
        1e-9,
    )


def measure_roofs(
    *,
    size: int = 1024,
    megabytes: int = 96,
    device: str = "cpu",
) -> Roofs:
    """Measure both limits of one core, or of a GPU, in about a second.

    Args:
        size: Rows and columns of the matrices; a large GPU needs 8192.
        megabytes: Size of each of two arrays, which should be larger than the caches.
        device: "cpu" or "cuda".
    """
    a, b = torch.rand(2, size, size).to(device)
    x, y = torch.rand(2, megabytes * 250_000).to(device)
    with threads(1):
        product_s = fastest_s(lambda: torch.mm(a, b), device=device)
        sum_s = fastest_s(lambda: y.add_(x), device=device)
    return Roofs(
        gflops=2 * size**3 / product_s / 1e9,
        gb_per_s=12 * len(x) / sum_s / 1e9,
    )


def kernel_points(
    make_work: Callable[[], Sequence[Work]] = mapping_work,
    *,
    repeats: int = 3,
    device: str = "cpu",
    backends: Sequence[str] = BACKENDS,
) -> list[KernelPoint]:
    """Time every operation on those of ``backends`` that have it on a device, on one thread.
    ``make_work`` creates the tensors there."""
    working = {(name, backend) for name, backend, state in report() if state == "ok"}
    points = []
    for backend in (b for b in backends if DEVICES[b] == device):
        for work in make_work():
            if not all((name, backend) in working for name in work.operations):
                continue
            with use_backend(backend), threads(1):
                seconds = fastest_s(work.run, repeats=repeats, device=device)
            points.append(
                KernelPoint(
                    name=work.name,
                    backend=backend,
                    flops=work.flops,
                    bytes=work.bytes,
                    seconds=seconds,
                )
            )
    return points


_COLOURS = {"reference": PALETTE[0], "numba": PALETTE[3], "triton": PALETTE[1]}


def roofline_figure(roofs: Roofs, points: Sequence[KernelPoint]) -> "Figure":
    """The two roofs, and a point for each kernel: hollow for the reference, filled for a fast
    backend."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.8, 4.4), dpi=100, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    intensities = [p.intensity for p in points] or [roofs.ridge]
    low = min(*intensities, 0.2) / 2
    high = max(*intensities, roofs.ridge) * 4
    x = [low * (high / low) ** (i / 100) for i in range(101)]
    axes.plot(
        x,
        [roofs.attainable_gflops(i) for i in x],
        color="#1c2430",
        linewidth=2,
    )
    axes.annotate(
        f"{roofs.gb_per_s:.0f} GB/s",
        (low, roofs.attainable_gflops(low)),
        xytext=(0, 34),
        textcoords="offset points",
        fontsize=9,
    )
    axes.annotate(
        f"{roofs.gflops:.0f} Gflop/s",
        (high, roofs.gflops),
        xytext=(-4, 6),
        textcoords="offset points",
        ha="right",
        fontsize=9,
    )
    for backend in dict.fromkeys(p.backend for p in points):
        own = [p for p in points if p.backend == backend]
        colour = _COLOURS.get(backend, PALETTE[2])
        fill = "none" if backend == "reference" else colour
        axes.scatter(
            [p.intensity for p in own],
            [p.gflops for p in own],
            s=60,
            edgecolors=colour,
            facecolors=fill,
            linewidths=1.6,
            label=backend,
            zorder=3,
        )
        for p in own if backend != "reference" else ():
            axes.annotate(
                p.name,
                (p.intensity, p.gflops),
                xytext=(9, -3),
                textcoords="offset points",
                ha="left",
                fontsize=8,
            )
    axes.set(xscale="log", yscale="log", xlabel="intensity, flop per byte", ylabel="Gflop/s")
    axes.set_ylim(top=roofs.gflops * 3)
    axes.grid(True, which="major", alpha=0.3)
    if points:
        axes.legend(loc="lower right", frameon=False, fontsize=9)
    return figure


def as_table(roofs: Roofs, points: Sequence[KernelPoint]) -> str:
    """Intensity, time, and share of the limit, one line per kernel."""
    lines = [
        f"{'kernel':20} {'backend':10} {'flop/byte':>9} {'ms':>7} {'Gflop/s':>8} "
        f"{'of the roof':>11}  limited by"
    ]
    for p in points:
        roof = roofs.attainable_gflops(p.intensity)
        limit = "memory" if p.intensity < roofs.ridge else "arithmetic"
        share = f"{100 * p.gflops / roof:.0f} %" if math.isfinite(roof) else ""
        lines.append(
            f"{p.name:20} {p.backend:10} {p.intensity:9.2f} {1e3 * p.seconds:7.1f} {p.gflops:8.2f} "
            f"{share:>11}  {limit}"
        )
    return "\n".join(lines)


ON_A_GPU = {"n": 200_000, "width": 1200, "height": 680}
"""Size of the work on a GPU; with less work the time to start kernels would dominate."""


def main(device: str, folder: Path) -> int:
    """``gsfusion-nb study roofline``: measure, print, and write the table and the picture to
    ``folder``."""
    if device not in ("cpu", "cuda"):
        raise ArgumentError(f"--device must be cpu or cuda, got {device!r}")
    if device == "cuda" and not torch.cuda.is_available():
        raise ArgumentError("--device cuda needs an NVIDIA GPU, but torch finds none")
    is_gpu = device == "cuda"
    roofs = measure_roofs(size=8192, megabytes=2000, device=device) if is_gpu else measure_roofs()
    work = functools.partial(mapping_work, **(ON_A_GPU if is_gpu else {}), device=device)
    points = kernel_points(work, repeats=10 if is_gpu else 5, device=device)
    head = header(describe(1))
    limits = (
        f"measured limits: {roofs.gflops:.0f} Gflop/s (matrix product), {roofs.gb_per_s:.0f} "
        "GB/s (b = a + b)"
    )
    text = "\n".join([*head, limits, "", as_table(roofs, points)])
    print(text)
    (folder / "roofline.txt").write_text(text + "\n", encoding="utf-8")
    roofline_figure(roofs, points).savefig(folder / "roofline.png")
    print(f"\nFiles in {folder}")
    return 0
