"""The command ``gsfusion-nb``: demo, convert, check, map, live, eval, study, bench, doctor."""

import logging
import sys
from dataclasses import dataclass, field
from typing import Annotated, Any

import tyro

from ..backends import BackendUnavailable, from_environment, use_backend
from ..config import DataConfig, gsfusion
from ..last_resort import is_foreseen, unforeseen
from .result import print_metrics, print_result
from .settings import named_values

_USAGE = """gsfusion-nb: online RGB-D mapping with TSDF fusion and 3D Gaussian splatting

  gsfusion-nb demo                     map the built-in room and open its report: about a minute
  gsfusion-nb convert SOURCE OUT       a recording of another kind (COLMAP, ROS, Record3D, ...), to check and map it
  gsfusion-nb check DATA               is a recording in order? what is wrong, and the options that repair it
  gsfusion-nb map DATA [options]       map a sequence; every setting is an option: gsfusion-nb map --help
  gsfusion-nb map --resume RUN         go on with a run that was interrupted
  gsfusion-nb live folder|realsense|kinect   map a camera, or a folder while it is written; Ctrl-C ends the scan
  gsfusion-nb eval RUN                 score a finished run again
  gsfusion-nb study NAME DATA          the papers' comparisons: systems, disc-depth, transparent, states, ...
  gsfusion-nb bench [GROUP]            what operations, mapping, panels cost on this machine, beside other programs
  gsfusion-nb doctor                   what is installed, what works, what to do
  gsfusion-nb doctor --warm            compile the fast kernels now instead of on first use
"""


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """Examine a recording: units, conventions, intrinsics, registration, times, images. Say what is wrong and which
    options of gsfusion-nb map repair it; they can be given here too, to see whether they do. Write one page."""

    path: Annotated[str, tyro.conf.Positional]
    """Folder of a sequence, or "room" for the built-in scene."""
    out: str = ""
    """The page to write; check-<name>.html by default."""
    frames: int = 250
    """About how many frames are read; a longer recording is read in windows of 31 consecutive ones."""
    format: str = "auto"
    """Layout of the data: the name of a file in gsfusion_nb/data/readers; recognised by its files by default."""
    reader: tuple[str, ...] = ()
    """Options of the layout's reader, name=value: register=true (7-Scenes), undistort=false (TUM), poses=false (folder,
    TUM), n_frames=480 (room)."""
    data: DataConfig = field(default_factory=DataConfig)


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """Map the built-in room and report on it."""

    out: str = ""
    """New or empty folder for the results; runs/room-<time> by default."""
    frames: int = 120
    """Frames of the built-in trajectory."""
    backend: str = field(default_factory=from_environment)
    """auto, reference, torch, numba, triton or cuda; by default what the variable GSFUSION_BACKEND says, else auto."""


@dataclass(frozen=True, kw_only=True)
class EvalOptions:
    """Score the maps of a finished run again, from the views and poses that the run is scored by. The numbers are the
    run's own; where they differ, this says so and keeps the run's beside them."""

    run: Annotated[str, tyro.conf.Positional]
    """Folder of the run."""
    data: str = ""
    """Where the sequence lies now, if it has moved."""
    lpips: bool = False
    """Also compute LPIPS (needs the extra "lpips" and AlexNet's weights)."""
    device: str = ""
    """Where to render: cpu or cuda; the run's by default."""
    backend: str = field(default_factory=from_environment)
    """auto, reference, torch, numba, triton or cuda; by default what the variable GSFUSION_BACKEND says, else auto."""


@dataclass(frozen=True, kw_only=True)
class DoctorOptions:
    """Say what is installed, what works and what to do where it does not."""

    warm: bool = False
    """Compile the fast kernels once instead, so that nothing waits for it later."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; the exit status: 0 done, 1 an error said in a sentence, 130 interrupted."""
    arguments = sys.argv[1:] if arguments is None else arguments
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    commands = {
        "demo": _demo,
        "convert": _convert,
        "check": _check,
        "map": _map,
        "live": _live,
        "eval": _eval,
        "bench": _bench,
        "study": _study,
        "doctor": _doctor,
    }
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_USAGE)
        return 0
    name, *rest = arguments
    if name not in commands:
        print(f"no command {name!r}\n\n{_USAGE}", file=sys.stderr)
        return 2
    try:
        return commands[name](rest)
    except Exception as e:
        text = e.args[0] if isinstance(e, KeyError) and e.args else e
        if not (isinstance(e, BackendUnavailable) or is_foreseen(e)):
            text = unforeseen(e, f"gsfusion-nb {name}", rest)
        print(f"gsfusion-nb {name}: {text}", file=sys.stderr)
        for note in getattr(e, "__notes__", ()):
            print(note, file=sys.stderr)
        return 1
    except KeyboardInterrupt as e:
        print(f"gsfusion-nb {name}: interrupted", file=sys.stderr)
        for note in getattr(e, "__notes__", ()):
            print(note, file=sys.stderr)
        return 130


def _map(arguments: list[str]) -> int:
    from . import map

    return map.run(arguments)


def _live(arguments: list[str]) -> int:
    from . import live

    return live.run(arguments)


def _convert(arguments: list[str]) -> int:
    from ..data.convert import command

    print(command.run(arguments))
    return 0


def _check(arguments: list[str]) -> int:
    from ..data.checkup import check_recording

    options = tyro.cli(CheckOptions, prog="gsfusion-nb check", args=arguments)
    reader: dict[str, Any] = {"format": options.format} if options.format != "auto" else {}
    reader |= named_values(options.reader)
    report = check_recording(options.path, data=options.data, frames=options.frames, **reader)
    print(report)
    page = report.write(options.out or f"check-{report.name}.html")
    print(f"Pictures and curves: {page}")
    return 1 if report.verdict == "wrong" else 0


def _demo(arguments: list[str]) -> int:
    from ..runs import run_mapping

    options = tyro.cli(DemoOptions, prog="gsfusion-nb demo", args=arguments)
    print("Mapping the built-in room, frame by frame; the first run also renders and caches its pictures.")
    with use_backend(options.backend):
        run = run_mapping("room", gsfusion("room"), folder=options.out or None, n_frames=options.frames)
    return print_result(run)


def _eval(arguments: list[str]) -> int:
    from ..runs import rescore

    options = tyro.cli(EvalOptions, prog="gsfusion-nb eval", args=arguments)
    with use_backend(options.backend):
        metrics = rescore(
            options.run, data=options.data or None, with_lpips=options.lpips, device=options.device or None
        )
    print_metrics(metrics)
    return 0


def _bench(arguments: list[str]) -> int:
    from .. import bench

    return bench.main(tyro.cli(bench.BenchOptions, prog="gsfusion-nb bench", args=arguments))


def _study(arguments: list[str]) -> int:
    from .. import studies

    return studies.main(tyro.cli(studies.StudyOptions, prog="gsfusion-nb study", args=arguments))


def _doctor(arguments: list[str]) -> int:
    from .. import doctor

    options = tyro.cli(DoctorOptions, prog="gsfusion-nb doctor", args=arguments)
    return doctor.warm() if options.warm else doctor.main()
