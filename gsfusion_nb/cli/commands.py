"""The commands of ``gsfusion-nb``: what each does, and where it is. A module is imported only when
its command is called."""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from .options import parse_options, print_names

PROGRAM = "gsfusion-nb"
_ABOUT = f"""{PROGRAM}: online RGB-D mapping with TSDF fusion and 3D Gaussian splatting

Options of a command, with their defaults: {PROGRAM} map --help"""


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command, and its line in the first help."""

    words: str = ""
    """What is typed after its name."""
    about: str
    """What it does."""
    module: str
    """Its module in the package."""
    function: str = "run"
    """What of the module does it; returns the exit status. It takes the parsed options, or the
    arguments if ``options`` is empty."""
    options: str = ""
    """Class of its options in the module."""

    def run(self, name: str, arguments: list[str]) -> int:
        """Do it, under its name.

        Code in files that nobody named is executed only if the user allows it.
        """
        module = importlib.import_module(f"gsfusion_nb.{self.module}")
        function = getattr(module, self.function)
        if not self.options:
            return function(arguments)
        from ..seeding.named_code import CodeNotNamedError
        from .permission import ask_or_refuse, naming_options

        prog = f"{PROGRAM} {name}"
        options: Any = getattr(module, self.options)
        try:
            return function(parse_options(options, prog=prog, arguments=arguments))
        except CodeNotNamedError as e:
            naming = naming_options(e, options)
            if not naming:
                raise
            ask_or_refuse(e, prog, arguments, naming)
        return self.run(name, [*arguments, *naming])


COMMANDS: Mapping[str, Command] = {
    "demo": Command(
        about="map the built-in room by two systems: a report of both, in a minute, and once a "
        "minute to compile",
        module="cli.demo",
        options="DemoOptions",
    ),
    "convert": Command(
        words="SOURCE OUT",
        about="convert a recording (COLMAP, ROS, Record3D, ...) to files that can be mapped",
        module="cli.convert",
        options="ConvertCommand",
    ),
    "excerpt": Command(
        words="DATA OUT",
        about="cut frames of a recording (--frames A:B:STEP)",
        module="cli.excerpt",
        options="ExcerptOptions",
    ),
    "check": Command(
        words="DATA",
        about="find errors in a recording, and the options that repair them",
        module="cli.check",
        options="CheckOptions",
    ),
    "map": Command(
        words="DATA",
        about="map a sequence; map --resume RUN: continue an interrupted run",
        module="cli.map",
    ),
    "locate": Command(
        words="RUN DATA",
        about="find the frames of another recording in the map of a run",
        module="cli.locate",
        options="LocateOptions",
    ),
    "live": Command(
        words="SOURCE",
        about="map a camera (realsense), or a folder while it is written (folder)",
        module="cli.live",
    ),
    "eval": Command(
        words="RUN",
        about="score a finished run again",
        module="cli.score",
        options="EvalOptions",
    ),
    "export": Command(
        words="RUN OUT",
        about="the maps for other programs, right side up: a .glb or .ply file, or a folder with "
        "all of them",
        module="cli.export",
        options="ExportOptions",
    ),
    "lab": Command(
        words="TABLE",
        about="compare seeding rules: rules x scenes x seeds x budgets, from a file (--new FILE "
        "writes one)",
        module="compare.command",
        function="main",
        options="LabOptions",
    ),
    "sweep": Command(
        words="DATA --grid X",
        about="compare values of settings",
        module="compare.sweep",
        function="sweep",
        options="SweepOptions",
    ),
    "study": Command(
        words="NAME DATA",
        about="run one of the papers' comparisons",
        module="compare.studies",
        function="study",
        options="StudyOptions",
    ),
    "benchmark": Command(
        words="NAME DIR",
        about="map all scenes of a data set by its published protocol, beside the numbers of the "
        "papers",
        module="compare.benchmark",
        function="benchmark",
        options="BenchmarkOptions",
    ),
    "bench": Command(
        words="[GROUP]",
        about="measure the speed of operations and mapping",
        module="compare.bench",
        function="main",
        options="BenchOptions",
    ),
    "course": Command(
        words="[DIR]",
        about="copy the notebooks of the course to a folder; without one: show how far you are in "
        "them; course export: the chapters as assignments for nbgrader",
        module="cli.course",
    ),
    "grade": Command(
        words="SUBMISSIONS",
        about="mark the notebooks of a class, each in a process of its own",
        module="cli.grade",
        options="GradeOptions",
    ),
    "doctor": Command(
        about="show what is installed, what works, and what to do where something does not; "
        "doctor --warm: compile the fast kernels now, not on first use",
        module="cli.doctor",
        options="DoctorOptions",
    ),
}


def print_help() -> None:
    """Print what ``gsfusion-nb --help`` shows."""
    lines = {
        name: f"{command.words}: {command.about}" if command.words else command.about
        for name, command in COMMANDS.items()
    }
    print_names(PROGRAM, _ABOUT, lines)
