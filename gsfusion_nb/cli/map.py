"""``gsfusion-nb map``: map a sequence, or continue a run that was interrupted."""

from dataclasses import dataclass
from typing import Annotated

import tyro

from ..backends import use_backend
from ..config import replace
from ..seeding.rule_code import is_rule_file
from ..work import MAP_MEMORY
from .result import print_result
from .settings import SettingsOptions, parse, recording_to_open

_WITH_RESUME = (
    "--resume", "--seeding.rule", "--device", "--evaluate", "--no-evaluate", "--backend", "--checkpoint-every-s",
    "--checkpoint-every-frames", "--memory-gb",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class MapOptions(SettingsOptions):
    """Map a sequence online, optimise over its keyframes, and score it. Writes maps, numbers and a report to a folder.

    Every setting of the chosen system is an option.
    """

    data: Annotated[str, tyro.conf.Positional] = ""
    """Folder of a sequence, or "room" for the built-in scene."""
    out: str = ""
    """New or empty folder for the results; runs/<name>-<time> by default."""
    format: str = "auto"
    """Layout of the data: auto (recognised by its files) or the name of a file in gsfusion_nb/data/readers, such as tum
    or replica."""
    reader: tuple[str, ...] = ()
    """Options of the layout's reader, name=value: register=true (7-Scenes), undistort=false (TUM), split=train
    (ScanNet++), poses=false (folder, TUM), n_frames=480 or rooms=64 (room)."""
    from_gaussians: str = ""
    """File of Gaussians that the map begins with (.ply), in metres, in the world frame of the recording's poses; they
    are optimised with the new ones. GSFusion only."""
    resume: str = ""
    """Folder of an interrupted run to continue; no other option is needed."""
    evaluate: bool = True
    """Score mapped and held-out views and write the report."""
    checkpoint_every_s: float = 30.0
    """Save the state of the run this often, seconds, so that --resume can continue after the process was killed; less
    often if saving takes more than 3 % of the time. 0: only when the run is interrupted."""
    checkpoint_every_frames: int = 0
    """Also save after every n-th frame. 0: no."""
    estimate_memory: bool = False
    """Only say how much memory the map will need; reads up to 200 frames and maps 8."""
    memory_gb: float = 0.0
    """Keep the map in temporary files, and what is far from the camera out of memory, so that the process needs about
    this many GB; the map is the same. On a processor only. 0: keep it in memory."""


def run(arguments: list[str]) -> int:
    """Run ``gsfusion-nb map ARGUMENTS``. Returns the exit status.

    Raises:
        ValueError, KeyError, OSError: invalid options, or data that cannot be mapped.
    """
    options = parse(MapOptions, "gsfusion-nb map", arguments, data="data")
    from ..data import open_sequence
    from ..runs import CheckpointEvery, estimate_memory, resume_mapping, run_mapping

    every = CheckpointEvery(seconds=options.checkpoint_every_s, frames=options.checkpoint_every_frames)
    if options.memory_gb and options.device != "cpu":
        raise ValueError("--memory-gb is for maps on a processor; leave it out, or take --device cpu")
    MAP_MEMORY.limit(options.memory_gb or None)
    with use_backend(options.backend):
        options.check_device()
        if options.resume:
            _refuse_more(options, arguments)
            finished = resume_mapping(
                options.resume,
                seeding=options.config.seeding.rule if is_rule_file(options.config.seeding.rule) else None,
                device=options.device,
                evaluate=options.evaluate,
                checkpoints=every,
            )
            return print_result(finished)
        if not options.data:
            raise ValueError("expected the folder of a sequence or the name of a built-in scene: gsfusion-nb map room")
        settings, (data, reader) = options.settings(), recording_to_open(options, options.data)
        if data != options.data and reader.get("poses") is False:
            settings = replace(settings, tracking__poses="tracked")
        if options.estimate_memory:
            needed = estimate_memory(open_sequence(data, data=settings.data, **reader), settings)
            parts = ", ".join(f"{gb:.2g} GB {what}" for what, gb in needed.items())
            print(f"about {sum(needed.values()):.2g} GB: {parts}; --memory-gb keeps the map in files")
            return 0
        finished = run_mapping(
            data,
            settings,
            folder=options.out or None,
            device=options.device,
            evaluate=options.evaluate,
            checkpoints=every,
            from_gaussians=options.from_gaussians or None,
            **reader,
        )
    return print_result(finished)


def _refuse_more(options: MapOptions, arguments: list[str]) -> None:
    """A resumed run has its own settings and data: raise ``ValueError`` if others are given."""
    more = [a for a in arguments if a.startswith("-") and a.split("=")[0] not in _WITH_RESUME]
    if more or options.data:
        raise ValueError(
            f"--resume continues with the run's own settings and data; leave out {options.data} {' '.join(more)}"
        )
