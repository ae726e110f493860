"""``gsfusion-nb bench``: time and memory of the operations on this machine; results are kept if it
is interrupted."""

import dataclasses
import functools
import importlib
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from torch import Tensor

from ... import backends, seeding  # noqa: F401  (importing the rooms declares their operations)
from ...backends import use_backend
from ...checks import check_name, check_whole
from ...config import DataConfig, TsdfConfig, gsfusion, replace
from ...config.options import named
from ...data import OpenedSequence, open_sequence
from ...data.room import RoomSequence
from ...errors import ArgumentError
from ...evaluation.image import psnr
from ...files import write_file
from ...geometry import se3
from ...mapping import SYSTEMS, GSFusion
from ...render import render_forward, render_vjp
from ...render.constants import NEAR_PLANE_M, SCREEN_BLUR_PX2
from ...tsdf import TsdfVolume, integrate, raycast
from ...types import GaussianParams
from ...work import PeakMemory, ProgressDisplay
from .scene import RandomScene, random_scene
from .timing import Lap, Timing, describe, header, lap, measure, summary, threads

TIMED_BACKENDS = ("reference", "numba", "cuda")
"""Those with a rasteriser and TSDF integration."""
DEVICES = {"reference": "cpu", "numba": "cpu", "triton": "cuda", "cuda": "cuda"}
"""Device of each backend."""
_WALK = 200
"""Frames of the room's walk; more frames are closer together on the same walk."""


@dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """Measure the speed of the toolkit on this machine and print a table."""

    what: Annotated[str, tyro.conf.Positional] = named(
        "all", lambda: ("all (but growth)", *SECTIONS)
    )
    """What to time: raster is the rasteriser, tsdf TSDF integration, map the whole mapper, growth
    the three systems in a building of 64 rooms, a quarter of an hour."""
    data: str = "room"
    """Folder of the sequence used by tsdf and map, or "room" for the built-in scene."""
    size: tuple[str, ...] = ()
    """Image sizes of the sequence, for example 320x240 640x480. Default: the size of the recording,
    320x240 for the room."""
    frames: int = 0
    """Number of frames of the sequence to use. 0: 60, or 8 with --quick."""
    backend: tuple[str, ...] = named((), lambda: TIMED_BACKENDS)
    """Backends of gsfusion-nb to time. Where none is given: all that run on this machine except
    reference, which is slow because it is written for reading."""
    threads: int = 1
    """Number of threads for every method."""
    quick: bool = False
    """Run few and small cases, in one or two minutes, to test that everything works."""
    json: str = ""
    """Write all numbers to this file, as JSON."""

    @property
    def sections(self) -> tuple[str, ...]:
        """Sections to run, in order."""
        return (
            tuple(name for name in SECTIONS if name != "growth")
            if self.what == "all"
            else (self.what,)
        )

    @property
    def n_frames(self) -> int:
        """Frames to use."""
        return self.frames or (8 if self.quick else 60)

    @property
    def budget_s(self) -> float:
        """Time for repeating one measurement, seconds."""
        return 0.3 if self.quick else 1.0

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Image sizes as (width, height); (0, 0) is the recording's own."""
        if not self.size:
            return [(320, 240) if self.data == "room" else (0, 0)]
        return [_parse_size(text) for text in self.size]

    def check(self) -> None:
        """Check the options before anything is run.

        Raises:
            KeyError, ValueError, OSError: an invalid option.
        """
        check_name("bench", self.what, ("all", *SECTIONS))
        for backend in self.backend:
            check_name("backend", backend, TIMED_BACKENDS)
        check_whole("--threads", self.threads, 1, os.cpu_count() or 1)
        check_whole("--frames", self.n_frames, 2)
        for size in self.sizes:
            if self.what != "raster":
                open_frames(self, size)


def _parse_size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()) or min(int(width), int(height)) < 32:
        raise ArgumentError(f"--size must look like 320x240, and be at least 32x32, got {text!r}")
    return int(width), int(height)


def open_frames(options: BenchOptions, size: tuple[int, int]) -> OpenedSequence:
    """The sequence that the options ask for, without held-out frames; nothing is read yet.

    Args:
        options: Of the command.
        size: Width and height; 0: as recorded.
    """
    data = DataConfig(
        width=size[0],
        height=size[1],
        stop=options.n_frames,
        hold_out_every=0,
    )
    room: dict[str, Any] = (
        {"n_frames": max(_WALK, options.n_frames)} if options.data == "room" else {}
    )
    return open_sequence(options.data, data=data, **room)


def _case_name(frames: OpenedSequence) -> str:
    """Sequence and size, short enough for the table."""
    name = frames.name if len(frames.name) <= 13 else frames.name[:12] + "~"
    return f"{name} {frames.camera.width}x{frames.camera.height}"


def our_backends(options: BenchOptions, *operations: str) -> list[str]:
    """The requested backends that can run all of ``operations`` on this machine, slow ones first.

    The reference is written for reading: it is timed only if the options name it.
    """
    working = {(name, backend) for name, backend, state in backends.report() if state == "ok"}
    usable = [b for b in backends.BACKENDS if all((name, b) in working for name in operations)]
    names = [
        b for b in usable if b in options.backend or (not options.backend and b != "reference")
    ]
    return [b for b in names if DEVICES[b] == "cpu" or torch.cuda.is_available()]


@dataclass(frozen=True, kw_only=True)
class BenchRow:
    """One line of the table."""

    section: str
    """Key of ``SECTIONS``."""
    case: str
    """The work."""
    method: str
    """The backend."""
    timing: Timing
    note: str = ""
    values: dict[str, Any] = field(default_factory=dict)
    """Further numbers, for the JSON file."""


COUNTS = (5_000, 20_000, 100_000)
SIZES = ((320, 240), (640, 480))
SH_DEGREES = (0, 3)
ON_A_GPU = (200_000, 1200, 680, 3, "cuda")
"""Gaussians, width, height, degree and device of the case that only runs on a GPU."""
GSPLAT = "gsplat (CUDA)"
"""Its rasteriser is timed beside ours in that case, where it is installed."""


def raster_rows(options: BenchOptions) -> Iterator[BenchRow]:
    """Random scenes, forward, and forward with the gradient of every parameter; on a GPU one large
    scene more, beside gsplat; the note is the PSNR of its picture against ours."""
    counts, sizes, degrees = (
        (COUNTS[:2], SIZES[:1], (3,)) if options.quick else (COUNTS, SIZES, SH_DEGREES)
    )
    cases = [(n, *size, degree, "cpu") for degree in degrees for size in sizes for n in counts]
    cases += [ON_A_GPU] if torch.cuda.is_available() else []
    for n, width, height, degree, device in cases:
        scene = random_scene(n, width, height, sh_degree=degree)
        for with_gradient in (False, True):
            title = (
                f"{n / 1000:g}k {width}x{height} SH{degree} {'fwd+bwd' if with_gradient else 'fwd'}"
            )
            ours = our_backends(options, "render_forward", "render_vjp")
            methods = [b for b in ours if device == "cpu" or DEVICES[b] == "cuda"]
            methods += [GSPLAT] if device == "cuda" and has_gsplat() else []
            for method in methods:
                device_name = DEVICES.get(method, "cuda")
                own_scene = scene.to(device_name)
                draw = by_gsplat if method == GSPLAT else functools.partial(_draw, method)
                timing = measure(
                    lambda d=draw, s=own_scene, v=with_gradient: d(s, v),
                    options.budget_s,
                    device_name,
                )
                note = (
                    f"{psnr(draw(own_scene, False), _draw(methods[0], own_scene, False)):.0f} dB"
                    if method == GSPLAT
                    else ""
                )
                yield BenchRow(
                    section="raster", case=title, method=method, timing=timing, note=note
                )


def _draw(backend: str, scene: RandomScene, with_gradient: bool) -> Tensor:
    with use_backend(backend):
        output, context = render_forward(scene.params, scene.camera, scene.T_WC, with_indices=False)
        if with_gradient:
            render_vjp(context, scene.v_rgb)
        return output.rgb


def has_gsplat() -> bool:
    """Whether gsplat is installed with its CUDA kernels, which it compiles with nvcc on first
    use."""
    try:
        return importlib.import_module("gsplat.cuda._backend")._C is not None
    except (ImportError, RuntimeError, OSError):
        return False


def by_gsplat(scene: RandomScene, with_gradient: bool) -> Tensor:
    """The picture that gsplat draws and, with ``backward``, dL/d of every parameter by its
    autograd."""
    from gsplat import rasterization  # pyright: ignore[reportMissingImports]

    p = GaussianParams(
        **{name: x.detach().requires_grad_(with_gradient) for name, x in vars(scene.params).items()}
    )
    pictures, _, _ = rasterization(
        means=p.xyz_W,
        quats=p.quat,
        scales=p.log_scale.exp(),
        opacities=p.opacity_logit.sigmoid(),
        colors=p.sh,
        viewmats=se3.inverse(scene.T_WC)[None],
        Ks=scene.camera.K.to(p.xyz_W)[None],
        width=scene.camera.width,
        height=scene.camera.height,
        near_plane=NEAR_PLANE_M,
        eps2d=SCREEN_BLUR_PX2,
        sh_degree=p.sh_degree,
        packed=False,
    )
    if with_gradient:
        torch.autograd.grad(
            pictures[0],
            list(vars(p).values()),
            scene.v_rgb,
        )
    return pictures[0].detach()


VOXEL_SIZES_M = (0.02, 0.01)
TRUNCATION_VOXELS = 4.0
FAR_M = 5.0
LOOK_EVERY = 4
"""Frames from one raycast to the next."""


def tsdf_rows(options: BenchOptions) -> Iterator[BenchRow]:
    """Integration with colour: decoded frames are fused one after another into an empty volume;
    then raycasts."""
    for size in options.sizes:
        sequence = open_frames(options, size)
        images = [sequence[i] for i in range(len(sequence))]
        for voxel_m in VOXEL_SIZES_M[:1] if options.quick else VOXEL_SIZES_M:
            config = TsdfConfig(
                voxel_size_m=voxel_m, truncation_voxels=TRUNCATION_VOXELS, near_m=0.0, far_m=FAR_M
            )
            for backend in our_backends(options, "band_blocks", "fuse_frame_"):
                device = DEVICES[backend]
                volumes = []
                frames = [frame.to(device) for frame in images]
                camera = frames[0].camera
                poses = [frame.T_WC for frame in frames[::LOOK_EVERY]]
                with use_backend(backend):
                    volume = TsdfVolume(config, device=device)
                    integrate(volume, frames[0])  # compiles, as does the first raycast
                    raycast(volume, camera, poses[0])
                    with PeakMemory(device) as memory:
                        volume = TsdfVolume(config, device=device)
                        laps = [
                            lap(
                                lambda v=volume, f=f, u=volumes: u.append(
                                    integrate(v, f).updated_voxels
                                ),
                                device,
                            )
                            for f in frames
                        ]
                    looks = [
                        lap(
                            lambda v=volume, c=camera, T=T: raycast(v, c, T),
                            device,
                        )
                        for T in poses
                    ]
                timing = summary(laps, memory.peak_mb)
                case = f"{_case_name(sequence)} {100 * voxel_m:g} cm"
                values = {
                    "frames": len(frames),
                    "blocks": volume.n_blocks,
                    "updated_voxels_per_frame": sum(volumes) / len(frames),
                }
                yield BenchRow(
                    section="tsdf", case=case, method=backend, timing=timing, values=values
                )
                yield BenchRow(
                    section="tsdf", case=f"{case} / raycast", method=backend, timing=summary(looks)
                )


STAGES = {
    "read": "read",
    "tsdf": "TSDF",
    "quadtree": "quadtree",
    "seeding": "seeding",
    "optimise": "optimisation",
}
"""Stage of the step's report -> its name in the table."""


def map_rows(options: BenchOptions) -> Iterator[BenchRow]:
    """The whole mapper by stage: the reference, if it is asked for, then the fastest backend of
    each operation.

    On a GPU the time of a stage ends when its work is queued; the time of the whole step includes
    its execution.
    """
    names = our_backends(options, "render_forward", "render_vjp")
    methods = [(b, b, "cpu") for b in names if b == "reference"]
    methods += [(f"auto ({b})", "auto", DEVICES[b]) for b in ("numba", "cuda") if b in names]
    for size in options.sizes:
        for method, backend, device in methods:
            with use_backend(backend):
                yield from _mapper_rows(open_frames(options, size), method, device)


def _mapper_rows(frames: OpenedSequence, method: str, device: str) -> Iterator[BenchRow]:
    config = gsfusion("online")
    n = len(frames)
    # compiles, and renders the first image of the room
    GSFusion(config, device=device).step(frames[0])
    for i in range(n):
        frames[i]  # images of the room are rendered once and kept
    seconds = dict.fromkeys(STAGES, 0.0)
    cpu_s = 0.0
    with PeakMemory(device) as memory:
        mapper = GSFusion(config, device=device)
        for i in range(n):
            start = time.perf_counter()
            frame = frames[i]
            seconds["read"] += time.perf_counter() - start
            cpu = time.process_time()
            report = mapper.step(frame)
            cpu_s += time.process_time() - cpu
            for stage, took in report.seconds.items():
                seconds[stage] = seconds.get(stage, 0.0) + took
    step_s = sum(took for stage, took in seconds.items() if stage != "read")
    values = {"frames": n, "frames_per_second": n / step_s, "n_gaussians": len(mapper.gaussians)}
    case = _case_name(frames)
    note = f"{n / step_s:.1f}/s, {len(mapper.gaussians) / 1e3:.1f}k"
    total = Timing(
        wall_ms=1e3 * step_s / n,
        cpu_ms=1e3 * cpu_s / n,
        runs=n,
        peak_mb=memory.peak_mb,
    )
    yield BenchRow(
        section="map",
        case=case,
        method=method,
        timing=total,
        note=note,
        values=values,
    )
    for stage, name in STAGES.items():
        each = Timing(
            wall_ms=1e3 * seconds[stage] / n,
            cpu_ms=0.0,
            runs=n,
            peak_mb=None,
        )
        share = "not counted" if stage == "read" else f"{100 * seconds[stage] / step_s:.0f} %"
        yield BenchRow(
            section="map", case=f"{case} / {name}", method=method, timing=each, note=share
        )


ROOMS = 64
ROOM_SIZE = (160, 120)
ROOM_FRAMES = 20
"""Rooms of the building of ``growth``; size and number of the images of each."""
_GROWTH_VOXEL_M = 0.04


def growth_rows(options: BenchOptions) -> Iterator[BenchRow]:
    """A square building of equal rooms through which the camera walks, room by room: the mean time
    of a frame in each.

    Rooms 1, 2, 3 to 4, 5 to 8 and so on have a row, the median of these rooms. The last note of a
    system has the exponent b of  time = a rooms^b  by least squares over all rooms. It is 0 if the
    size of the map does not matter.
    """
    if options.data != "room":
        raise ArgumentError(
            f"the building of growth is made of the built-in room; leave out --data {options.data}"
        )
    n_rooms = 4 if options.quick else ROOMS
    n_frames = options.frames or (3 if options.quick else ROOM_FRAMES)
    width, height = options.sizes[0] if options.size else ROOM_SIZE
    building = RoomSequence(n_frames=n_frames, rooms=n_rooms, width=width, height=height)
    case = f"room {width}x{height}, rooms"
    for name, system in SYSTEMS.items():
        config = system.preset("room")
        laps = list[Lap]()
        config = (
            replace(config, tsdf__voxel_size_m=_GROWTH_VOXEL_M)
            if hasattr(config, "tsdf")
            else config
        )
        warm = system(config)
        mapper = system(config)
        for i in range(n_frames):
            warm.step(building[i])  # loads kernels
        with PeakMemory() as memory:
            for n in range(1, n_rooms + 1):
                frames = [building[i] for i in range((n - 1) * n_frames, n * n_frames)]
                took = lap(lambda m=mapper, f=frames: [m.step(frame) for frame in f])
                laps.append(Lap(took.wall_s / n_frames, took.cpu_s / n_frames))
                if n < n_rooms and n & (n - 1) == 0:
                    yield _growth_row(case, name, len(mapper.gaussians), laps)
        b = np.polyfit(
            np.log(np.arange(1, n_rooms + 1)),
            np.log([x.cpu_s for x in laps]),
            1,
        )[0]
        yield _growth_row(
            case, name, len(mapper.gaussians), laps, f", exponent {b:.2f}", memory.peak_mb
        )


def _growth_row(
    case: str,
    name: str,
    n: int,
    laps: list[Lap],
    more: str = "",
    mb: float | None = None,
) -> BenchRow:
    half = len(laps) // 2
    case = f"{case} {half + 1} to {len(laps)}"
    note = f"{n / 1e3:.1f}k{more}"
    timing = summary(laps[half:], mb)
    values = {"n_gaussians": n}
    return BenchRow(
        section="growth", case=case, method=name, timing=timing, note=note, values=values
    )


SECTIONS: dict[str, tuple[str, Callable[[BenchOptions], Iterator[BenchRow]]]] = {
    "raster": ("Gaussian rasteriser", raster_rows),
    "tsdf": ("integration with colour, truncation 4 voxels; raycasts", tsdf_rows),
    "map": (
        "GSFusion, Replica settings, means over the frames; note: frames/s, number of Gaussians",
        map_rows,
    ),
    "growth": (
        "a building, room by room, means over the frames; note: number of Gaussians",
        growth_rows,
    ),
}
_HEADINGS = ("case", "method", "wall ms", "CPU ms", "GPU ms", "MB", "runs", "note")


def main(options: BenchOptions) -> int:
    """Run, print the table and write the JSON file. Returns 0, or 130 after Ctrl-C with the
    measurements so far.

    Raises:
        KeyError, ValueError, OSError: invalid options; raised before anything is run.
    """
    options.check()
    rows: list[BenchRow] = []
    is_interrupted = False
    with threads(options.threads), ProgressDisplay("bench", unit="row", leave=False) as progress:
        machine = describe(options.threads)
        try:
            for section in options.sections:
                for row in SECTIONS[section][1](options):
                    rows.append(row)
                    progress.show(len(rows), note=f"{section}: {row.case}")
        except KeyboardInterrupt:
            is_interrupted = True
    print("\n".join(header(machine)))
    for section in options.sections:
        cells = [_cells(row) for row in rows if row.section == section]
        print(
            "\n".join(
                [
                    "",
                    f"**{section}**: {SECTIONS[section][0]}",
                    "",
                    *_table_lines([_HEADINGS, *cells]),
                ]
            )
        )
    print(
        "\nMedians of several runs. CPU ms: all threads together. GPU ms: between two events in "
        "its queue."
    )
    if options.json:
        document = {
            "machine": machine,
            "options": dataclasses.asdict(options),
            "interrupted": is_interrupted,
            "rows": [dataclasses.asdict(row) for row in rows],
        }
        write_file(
            Path(options.json).expanduser(),
            json.dumps(document, indent=1) + "\n",
        )
        print(f"All numbers: {options.json}")
    if is_interrupted:
        print("Interrupted.")
    return 130 if is_interrupted else 0


def _cells(row: BenchRow) -> tuple[str, ...]:
    t = row.timing
    times = (
        "" if not ms else f"{ms:.0f}" if ms >= 100 else f"{ms:.2f}"
        for ms in (t.wall_ms, t.cpu_ms, t.device_ms)
    )
    memory = "" if t.peak_mb is None else f"{t.peak_mb:.0f}"
    return (row.case, row.method, *times, memory, str(t.runs), row.note)


def _table_lines(rows: list[tuple[str, ...]]) -> list[str]:
    """Lines of a Markdown table, headings first, whose columns are also aligned in a terminal."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        f"| {' | '.join(cell.ljust(w) for cell, w in zip(row, widths, strict=True))} |"
        for row in rows
    ]
    return [lines[0], f"|{'|'.join('-' * (w + 2) for w in widths)}|", *lines[1:]]
