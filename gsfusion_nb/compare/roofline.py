"""The roofline of this machine (Williams, Waterman & Patterson 2009), and where this package's
kernels are below it.

    attainable flop/s = min(peak flop/s, intensity x bandwidth),   intensity = flop / bytes moved

Operations and bytes are counted by hand, from the formulas; bytes are those that must move at least
once (inputs read, outputs written). Further work of a kernel (sorting, gathering, reading twice)
shows as a lower speed.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from ..backends import BACKENDS, report, use_backend
from ..config import TsdfConfig
from ..errors import ArgumentError
from ..optim import ColumnRates, adam_update_map, dssim_vjp, l1_mse_vjp
from ..render import render_forward, render_vjp
from ..tsdf import TsdfVolume, allocate
from ..tsdf.integrate import fuse_frame_
from ..types import Frame, GaussianParams
from .bench.run import DEVICES
from .bench.scene import random_scene
from .bench.timing import describe, header, lap, threads

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ROW = {"xyz_W": (3,), "log_scale": (3,), "quat": (4,), "opacity_logit": (), "sh": (16, 3)}
FLOATS_PER_GAUSSIAN = sum(math.prod(shape) for shape in _ROW.values())
"""Centre, log scale, quaternion, opacity, SH of degree 3."""

ADAM_FLOPS = 12
ADAM_FLOATS = 7
"""Per number. m: 3, v: 4, step: sqrt, +, /, x, - = 5. Read value, gradient, m, v; write value, m,
v."""
FORWARD_FLOPS = 30
"""Per pair (pixel, Gaussian): sigma 10, exp counted as 8, alpha 2, transmittance 2, four channels
and alpha 8."""
BACKWARD_FLOPS = 70
"""Per pair: alpha again 20, dL/dalpha 12, dL/dcolour 8, dL/dconic, dL/duv, dL/dopacity 30."""
SSIM_FLOPS = 5 * 2 * 11 * 2 + 3 * 2 * 11 * 2 + 40
"""Per number: five maps blurred forwards and three backwards, each with an 11-tap filter twice, and
the quotient."""
L1_FLOPS = 9
L1_FLOATS = 3
"""Per number: difference, size, sign, clamp, square, two sums. Read picture and photograph, write
the gradient."""
TSDF_FLOPS = 40
TSDF_FLOATS = 10
"""Per observed voxel: projection 12, distance along the ray 10, three running means 18. Read and
write distance, weight and colour."""


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


@dataclass(frozen=True, kw_only=True)
class Work:
    """An operation to time, with its counted flop and bytes."""

    name: str
    operations: tuple[str, ...]
    """Names of operations, see ``backends.operations``."""
    run: Callable[[], object]
    flops: float | int
    bytes: float | int


def mapping_work(
    n: int = 20_000,
    width: int = 320,
    height: int = 240,
    per_pixel: float = 30.0,
    device: str = "cpu",
) -> list[Work]:
    """The main operations of a mapping step, on a random scene.

    Args:
        n: Number of Gaussians, with SH of degree 3; Adam gets five times as many, which do not fit
            in a cache.
        width, height: Size of the image, pixels.
        per_pixel: Mean number of Gaussians above alpha = 1/255 at a pixel.
        device: Where the tensors are.
    """
    scene = random_scene(n, width, height, sh_degree=3, per_pixel=per_pixel).to(device)
    pixels = width * height
    numbers = n * FLOATS_PER_GAUSSIAN
    pairs = per_pixel * pixels
    g = torch.Generator().manual_seed(0)
    rows = 5 * n  # too much for a cache
    params, gradients, m, v = (
        GaussianParams(
            **{
                name: torch.rand(rows, *shape, generator=g).to(device)
                for name, shape in _ROW.items()
            }
        )
        for _ in range(4)
    )
    rates = ColumnRates(*[1e-3] * len(ColumnRates._fields))
    image, target = (torch.rand(height, width, 3, generator=g).to(device) for _ in range(2))
    depth_m = (1.5 + 0.5 * torch.rand(height, 1, generator=g)).expand(height, width).contiguous()
    frame = Frame(
        index=0,
        timestamp_s=0.0,
        rgb=image.cpu(),
        depth_m=depth_m,
        camera=scene.camera,
        T_WC=torch.eye(4),
    ).to(device)

    def forward():
        return render_forward(scene.params, scene.camera, scene.T_WC, with_indices=False)

    @functools.cache
    def saved():
        return forward()[1]

    def backward():
        return render_vjp(saved(), scene.v_rgb)

    @functools.cache
    def volume() -> tuple[TsdfVolume, int]:
        """A volume after the frame, and the number of observed voxels."""
        new_volume = TsdfVolume(TsdfConfig(), device=device)
        allocate(new_volume, frame)
        return new_volume, fuse_frame_(new_volume, frame)

    voxels = volume()[1]
    return [
        Work(
            name="Adam",
            operations=("adam_update_map",),
            flops=ADAM_FLOPS * 5 * numbers,
            bytes=4 * ADAM_FLOATS * 5 * numbers,
            run=lambda: adam_update_map(
                params, gradients, m, v, None, rates=rates, beta1=0.9, beta2=0.999, eps=1e-15
            ),
        ),
        Work(
            name="L1 and gradient",
            operations=("l1_mse_vjp",),
            flops=L1_FLOPS * 3 * pixels,
            bytes=4 * L1_FLOATS * 3 * pixels,
            run=lambda: l1_mse_vjp(image, target),
        ),
        Work(
            name="D-SSIM and gradient",
            operations=("dssim_vjp",),
            flops=SSIM_FLOPS * 3 * pixels,
            bytes=4 * 3 * 3 * pixels,
            run=lambda: dssim_vjp(image, target),
        ),
        Work(
            name="render",
            operations=("render_forward",),
            flops=FORWARD_FLOPS * pairs,
            bytes=4 * (numbers + 5 * pixels),
            run=forward,
        ),
        Work(
            name="render, gradient",
            operations=("render_forward", "render_vjp"),
            flops=BACKWARD_FLOPS * pairs,
            bytes=4 * (2 * numbers + 8 * pixels),
            run=backward,
        ),
        Work(
            name="TSDF update",
            operations=("fuse_frame_",),
            flops=TSDF_FLOPS * voxels,
            bytes=4 * (TSDF_FLOATS * voxels + 4 * pixels),
            run=lambda: fuse_frame_(volume()[0], frame),
        ),
    ]


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


_COLOURS = {"reference": "#3d85c6", "numba": "#d1495b", "triton": "#8e5bb5"}


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
        colour = _COLOURS.get(backend, "#6a9e1f")
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
