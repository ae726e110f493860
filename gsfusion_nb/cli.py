"""The command ``gsfusion-nb``: demo, convert, check, map, live, eval, study, bench, doctor."""

import json
import logging
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from .backends import BackendUnavailable, from_environment, use_backend
from .config import DataConfig, GSFusionConfig, RtgSlamConfig, from_dict, gsfusion, replace, rtg_slam

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
class MapOptions:
    """Map a sequence online, optimise over its keyframes, score it; write maps, numbers and a report to a folder."""

    data: Annotated[str, tyro.conf.Positional] = ""
    """Folder of a sequence, or "room" for the built-in scene."""
    system: Literal["gsfusion", "rtg_slam"] = "gsfusion"
    """Which published system maps."""
    preset: str = "replica"
    """Settings as published for a data set; single options override it."""
    fidelity: Literal["measured", "paper", "code"] = "measured"
    """RTG-SLAM: where paper and released code differ, which to follow; or of each what measured better."""
    out: str = ""
    """New or empty folder for the results; runs/<name>-<time> by default."""
    format: str = "auto"
    """Layout of the data: the name of a file in gsfusion_nb/data/readers; recognised by its files by default."""
    split: str = ""
    """Which published split to map (ScanNet++: train or test)."""
    reader: tuple[str, ...] = ()
    """Options of the layout's reader, name=value: register=true (7-Scenes), undistort=false (TUM), poses=false (folder,
    TUM), n_frames=480 (room)."""
    resume: str = ""
    """Folder of an interrupted run to go on with; no other option is needed."""
    from_config: str = ""
    """A config.json of an earlier run whose settings to start from instead of a preset."""
    device: str = "cpu"
    """Where the maps live: cpu or cuda."""
    backend: str = field(default_factory=from_environment)
    """auto, reference, torch, numba, triton or cuda; by default what the variable GSFUSION_BACKEND says, else auto."""
    evaluate: bool = True
    """Score mapped and held-out views and write the report."""
    rule_options: tuple[str, ...] = ()
    """Options of the seeding rule, such as: --rule-options share=0.2 transparent=false."""


@dataclass(frozen=True, kw_only=True)
class GSFusionMapOptions(MapOptions):
    """Map a sequence online with GSFusion (--system rtg_slam: with RTG-SLAM), optimise over its keyframes, score it;
    write maps, numbers and a report to a folder."""

    config: Annotated[GSFusionConfig, tyro.conf.arg(name="")] = field(default_factory=GSFusionConfig)


@dataclass(frozen=True, kw_only=True)
class RtgSlamMapOptions(MapOptions):
    """Map a sequence online with RTG-SLAM, optimise over its keyframes, score it; write maps, numbers and a report to a
    folder."""

    config: Annotated[RtgSlamConfig, tyro.conf.arg(name="")] = field(default_factory=RtgSlamConfig)


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
    """Score the maps of a finished run again on the sequence they were made from."""

    run: Annotated[str, tyro.conf.Positional]
    """Folder of the run."""
    data: str = ""
    """Where the sequence lies now, if it has moved."""
    lpips: bool = False
    """Also compute LPIPS (needs the extra "lpips" and AlexNet's weights)."""


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
    except (ValueError, OSError, KeyError, BackendUnavailable, MemoryError) as e:
        text = e.args[0] if isinstance(e, KeyError) and e.args else e
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
    from .runs import resume_mapping, run_mapping

    options = tyro.cli(
        type(default := _map_defaults(arguments)), prog="gsfusion-nb map", args=arguments, default=default
    )
    with use_backend(options.backend):
        _check_device(options.device)
        if options.resume:
            others = [a for a in arguments if a.startswith("-")]
            extra = [a for a in others if a.split("=")[0] not in ("--resume", "--device", "--no-evaluate", "--backend")]
            if extra or options.data:
                raise ValueError(
                    f"--resume goes on with the run's own settings and data; leave out {options.data} {' '.join(extra)}"
                )
            return _finish(resume_mapping(options.resume, device=options.device, evaluate=options.evaluate))
        if not options.data:
            raise ValueError("expected the folder of a sequence or the name of a built-in scene: gsfusion-nb map room")
        reader: dict[str, Any] = {"format": options.format} if options.format != "auto" else {}
        reader |= _named_values(options.reader)
        if options.split:
            reader["split"] = options.split
        run = run_mapping(
            options.data,
            replace(
                options.config, seeding__options=options.config.seeding.options | _named_values(options.rule_options)
            ),
            folder=options.out or None,
            device=options.device,
            evaluate=options.evaluate,
            **reader,
        )
    return _finish(run)


def _live(arguments: list[str]) -> int:
    from .runs import live_command

    if not arguments or arguments[0] in ("-h", "--help"):
        print(live_command.USAGE)
        return 0
    return _finish(live_command.live(arguments))


def _convert(arguments: list[str]) -> int:
    from .data.convert import command

    print(command.run(arguments))
    return 0


def _check(arguments: list[str]) -> int:
    from .data.checkup import check_recording

    options = tyro.cli(CheckOptions, prog="gsfusion-nb check", args=arguments)
    reader: dict[str, Any] = {"format": options.format} if options.format != "auto" else {}
    reader |= _named_values(options.reader)
    report = check_recording(options.path, data=options.data, frames=options.frames, **reader)
    print(report)
    page = report.write(options.out or f"check-{report.name}.html")
    print(f"Pictures and curves: {page}")
    return 1 if report.verdict == "wrong" else 0


def _named_values(texts: tuple[str, ...]) -> dict[str, Any]:
    """``name=value`` texts as numbers, true or false, or words."""
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ValueError(f"expected an option as name=value, got {text!r}")
        try:
            values[name.replace("-", "_")] = json.loads(value.lower())
        except json.JSONDecodeError:
            values[name.replace("-", "_")] = value
    return values


def _check_device(name: str) -> None:
    import torch

    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError, NotImplementedError) as e:
        reason = str(e).splitlines()[0]
        raise ValueError(f"--device {name} cannot be used here, expected cpu or a CUDA device: {reason}") from None


def _map_defaults(arguments: list[str]) -> GSFusionMapOptions | RtgSlamMapOptions:
    """The system, and the preset or config file, named among ``arguments``: tyro shows and overrides its fields."""
    from .mapping import get_system

    name = _value_of(arguments, "--system") or "gsfusion"
    path = _value_of(arguments, "--from-config")
    preset = _value_of(arguments, "--preset") or ("room" if "room" in arguments[:1] else "replica")
    fidelity = _value_of(arguments, "--fidelity") or "measured"
    if path:
        try:
            document = json.loads(Path(path).read_text(encoding="utf-8"))
            name = document.get("system", "gsfusion")
            config = from_dict(get_system(name).config_type, document["config"])
        except (json.JSONDecodeError, KeyError, TypeError) as e:
            raise ValueError(f"{path} is no config.json of a run: {type(e).__name__} {e}") from None
    elif name == "rtg_slam":
        config = rtg_slam(preset, fidelity)
    else:
        config = get_system(name).preset(preset)
    if isinstance(config, RtgSlamConfig):
        return RtgSlamMapOptions(config=config, preset=preset, fidelity=fidelity, system="rtg_slam")  # pyright: ignore
    return GSFusionMapOptions(config=config, preset=preset)


def _value_of(arguments: list[str], option: str) -> str | None:
    for i, argument in enumerate(arguments):
        if argument.replace("_", "-") == option and i + 1 < len(arguments):
            return arguments[i + 1]
        if argument.replace("_", "-").startswith(f"{option}="):
            return argument.split("=", 1)[1]
    return None


def _demo(arguments: list[str]) -> int:
    from .runs import run_mapping

    options = tyro.cli(DemoOptions, prog="gsfusion-nb demo", args=arguments)
    print("Mapping the built-in room, frame by frame; the first run also renders and caches its pictures.")
    with use_backend(options.backend):
        run = run_mapping("room", gsfusion("room"), folder=options.out or None, n_frames=options.frames)
    return _finish(run)


def _eval(arguments: list[str]) -> int:
    from .runs import rescore

    options = tyro.cli(EvalOptions, prog="gsfusion-nb eval", args=arguments)
    _print_metrics(rescore(options.run, data=options.data or None, with_lpips=options.lpips))
    return 0


def _bench(arguments: list[str]) -> int:
    from . import bench

    return bench.main(tyro.cli(bench.BenchOptions, prog="gsfusion-nb bench", args=arguments))


def _study(arguments: list[str]) -> int:
    from . import studies

    return studies.main(tyro.cli(studies.StudyOptions, prog="gsfusion-nb study", args=arguments))


def _doctor(arguments: list[str]) -> int:
    from . import doctor

    options = tyro.cli(DoctorOptions, prog="gsfusion-nb doctor", args=arguments)
    return doctor.warm() if options.warm else doctor.main()


def _finish(run) -> int:
    _print_metrics(run.metrics)
    for warning in run.run.warnings:
        print(f"note: {warning}")
    print(f"Files in {run.folder}:")
    for path in sorted(run.folder.iterdir()):
        print(f"  {path.name:<16} {path.stat().st_size / 1e6:8.2f} MB")
    interrupted = run.run.status == "interrupted"
    if interrupted and run.run.resumable:
        print(f"To go on: gsfusion-nb map --resume {run.folder}")
    return 130 if interrupted else 0


def _print_metrics(metrics: dict[str, Any]) -> None:
    from .evaluation.metrics import METRIC_GROUPS, format_metric

    for group, known in METRIC_GROUPS.items():
        rows = [(metric.label, format_metric(name, metrics[name])) for name, metric in known.items() if name in metrics]
        if rows:
            print(group)
        for label, value in rows:
            print(f"  {label:<28} {value}")
