"""The command ``gsfusion-nb`` and what its first word means: demo, convert, check, map, live, and
so on."""

import errno
import importlib
import io
import logging
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ..backends import backend_names, from_environment, use_backend
from ..config import DataConfig, gps_slam, gsfusion
from ..config.options import named
from ..errors import FORESEEN, crash_sentence
from .options import parse_options
from .result import print_metrics, print_result
from .settings import layout_names, recording_to_open

_USAGE = Path(__file__).with_name("static").joinpath("usage.txt").read_text(encoding="utf-8")


_REFUSED = {
    errno.EACCES: "permission denied",
    errno.EPERM: "permission denied",
    errno.EROFS: "the file system is read-only",
}
"""Errors of a place that may not be read or written."""

NOBODY_READS = 141
"""Exit status, as of a program that the signal SIGPIPE ended."""


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """Examine a recording: units, conventions, intrinsics, registration, times, images.

    Reports errors and the options of gsfusion-nb map that repair them; the same options can be
    given here to test them. Writes an HTML page."""

    path: Annotated[str, tyro.conf.Positional]
    """Folder of a sequence, or "room" for the built-in scene."""
    format: str = named("auto", layout_names)
    """Layout of the data."""
    reader: tuple[str, ...] = ()
    """Options of the layout's reader, name=value: register=true (7-Scenes), undistort=false (TUM),
    poses=false (folder, TUM), n_frames=480 (room)."""
    data: DataConfig = field(default_factory=DataConfig)
    out: str = ""
    """Name of the HTML file. Default: check-<name>.html."""
    frames: int = 250
    """Approximate number of frames to read; a longer recording is read in windows of 31 consecutive
    frames."""


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """Map the built-in room by GSFusion and by GPS-SLAM, and write a report of both, side by
    side."""

    out: str = ""
    """New or empty folder for the results, with a folder of each run; runs/room-<time> by
    default."""
    frames: int = 120
    """Number of frames, spread evenly over one walk through the room. More: a better map, and more
    time."""
    backend: str = named(from_environment, backend_names)
    """What the operations run on; the environment variable GSFUSION_BACKEND changes the default."""


@dataclass(frozen=True, kw_only=True)
class EvalOptions:
    """Score the maps of a finished run again, with the views and poses of the run.

    The numbers should be the same; where they differ, the command reports both."""

    run: Annotated[str, tyro.conf.Positional]
    """Folder of the run."""
    data: str = ""
    """Folder of the sequence, if it was moved."""
    lpips: bool = False
    """Also compute LPIPS (needs the extra "lpips" and AlexNet's weights)."""
    device: str = ""
    """Where to render: cpu or cuda. Default: as in the run."""
    backend: str = named(from_environment, backend_names)
    """What the operations run on; the environment variable GSFUSION_BACKEND changes the default."""


@dataclass(frozen=True, kw_only=True)
class DoctorOptions:
    """Show what is installed, what works, and what to do where something does not."""

    warm: bool = False
    """Only compile the fast kernels, so that later commands start faster."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line. Exit status: 0 done, 1 an error (its message is printed), 3 a map that
    ends before its recording (``print_result``), 130 interrupted, 141 nobody reads the output any
    more."""
    for stream in (sys.stdout, sys.stderr):
        # a path in another script ends no command on a terminal of cp1252
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        status = _main(sys.argv[1:] if arguments is None else arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # Python's end says nothing, either
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return NOBODY_READS
    return status


def _main(arguments: list[str]) -> int:
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_USAGE)
        return 0
    name, *rest = arguments
    if name not in (*_MODULES, *_COMMANDS, *_COMPARING):
        print(f"no command {name!r}\n\n{_USAGE}", file=sys.stderr)
        return 2
    try:
        if name in _MODULES:
            return importlib.import_module(f".{name}", __package__).run(rest)
        if name in _COMPARING:
            return _compare(name, rest)
        return _COMMANDS[name](rest)
    except BrokenPipeError:
        raise
    except Exception as e:
        text = str(e)
        if isinstance(e, OSError) and e.errno in _REFUSED and e.filename:
            place = os.path.abspath(os.fsdecode(e.filename))
            text = (
                f"{_REFUSED[e.errno]}: {place}; expected to read it, or to write there: --out "
                "names another folder"
            )
        elif not isinstance(e, FORESEEN):
            text = crash_sentence(e, f"gsfusion-nb {name}", rest)
        print(f"gsfusion-nb {name}: {text}", file=sys.stderr)
        for note in getattr(e, "__notes__", ()):
            print(note, file=sys.stderr)
        return 1
    except KeyboardInterrupt as e:
        print(f"gsfusion-nb {name}: interrupted", file=sys.stderr)
        for note in getattr(e, "__notes__", ()):
            print(note, file=sys.stderr)
        return 130


def _convert(arguments: list[str]) -> int:
    from .convert import convert_command

    print(convert_command(arguments))
    return 0


def _excerpt(arguments: list[str]) -> int:
    from ..recordings.excerpt import ExcerptOptions, excerpt

    options = parse_options(ExcerptOptions, prog="gsfusion-nb excerpt", arguments=arguments)
    print(excerpt(options))
    return 0


def _check(arguments: list[str]) -> int:
    from ..recordings.checkup import check_recording

    options = parse_options(CheckOptions, prog="gsfusion-nb check", arguments=arguments)
    path, reader = recording_to_open(options, options.path)
    report = check_recording(path, data=options.data, frames=options.frames, **reader)
    print(report)
    page = report.write(options.out or f"check-{report.name}.html")
    print(f"Pictures and curves: {page}")
    return 1 if report.verdict == "wrong" else 0


def _demo(arguments: list[str]) -> int:
    from ..runs import run_mapping
    from ..runs.run_folder import new_folder
    from ..runs.side_by_side import numbers_of, write_side_by_side

    options = parse_options(DemoOptions, prog="gsfusion-nb demo", arguments=arguments)
    runs = []
    with use_backend(options.backend):
        folder = new_folder("room", options.out or None)
        print("Mapping the built-in room; the first run also renders its images and stores them.")
        for name, config in (("gsfusion", gsfusion("room")), ("gps_slam", gps_slam("room"))):
            run = run_mapping("room", config, folder=folder / name, n_frames=options.frames)
            if run.run.status != "complete":
                return print_result(run)
            runs.append(run)
        page = write_side_by_side(folder / "report.html", runs)
    for cells in numbers_of(runs):
        print(f"{cells[0]:<30}" + "".join(f"{cell:>18}" for cell in cells[1:]))
    print("Both maps, trajectory, numbers and report of each:", *(run.folder for run in runs))
    print(f"Side by side: {page}")
    return 0


def _eval(arguments: list[str]) -> int:
    from ..runs import rescore

    options = parse_options(EvalOptions, prog="gsfusion-nb eval", arguments=arguments)
    with use_backend(options.backend):
        metrics = rescore(
            options.run,
            data=options.data or None,
            with_lpips=options.lpips,
            device=options.device or None,
        )
    print_metrics(metrics)
    return 0


def _compare(name: str, arguments: list[str]) -> int:
    from ..seeding.named_rules import RuleNotNamedError
    from .permission import ask_or_refuse

    module, function, options = _COMPARING[name]
    found = importlib.import_module(f"gsfusion_nb.compare.{module}")
    prog = f"gsfusion-nb {name}"
    try:
        return getattr(found, function)(
            parse_options(getattr(found, options), prog=prog, arguments=arguments)
        )
    except RuleNotNamedError as e:
        files = dict.fromkeys(rule.rpartition(":")[0] for rule in e.rules)
        named = [word for file in files for word in ("--rule-file", file)]
        ask_or_refuse(e, prog, arguments, named)
    return _compare(name, [*arguments, *named])


def _doctor(arguments: list[str]) -> int:
    from . import doctor

    options = parse_options(DoctorOptions, prog="gsfusion-nb doctor", arguments=arguments)
    return doctor.warm() if options.warm else doctor.main()


_MODULES = ("map", "live", "export", "course", "grade")
"""Commands that are modules of this package, with a function ``run``."""
_COMMANDS = {
    "demo": _demo,
    "convert": _convert,
    "excerpt": _excerpt,
    "check": _check,
    "eval": _eval,
    "doctor": _doctor,
}
_COMPARING = {
    "lab": ("command", "main", "LabOptions"),
    "sweep": ("studies", "sweep", "SweepOptions"),
    "study": ("studies", "study", "StudyOptions"),
    "benchmark": ("benchmark", "benchmark", "BenchmarkOptions"),
    "bench": ("bench", "main", "BenchOptions"),
}
"""Command -> its module in ``compare``, function, and class of options."""
