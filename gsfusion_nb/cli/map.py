"""``gsfusion-nb map``: map a sequence, or continue a run that was interrupted."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from ..backends import use_backend
from ..checks import shown
from ..config import TsdfConfig, replace
from ..config.options import named
from ..errors import ArgumentError
from ..resources import MAP_MEMORY
from ..seeding.code_files import is_code_file
from ..seeding.named_code import CodeNotNamedError
from ..tsdf import estimate_memory
from .permission import ask_or_refuse
from .settings import SettingsOptions, layout_names, parse, recording_to_open
from .watch import WatchOptions

if TYPE_CHECKING:
    from ..config import SystemConfig
    from ..data import FrameSubset, OpenedSequence
    from ..runs import CheckpointEvery, FinishedRun
    from ..viz import BrowserTab

_NAMING = {"rule": "--seeding.rule", "system": "--system"}
"""Kind of code -> the option that names it."""
_WITH_RESUME = (
    "--resume",
    "--seeding.rule",
    "--system",
    "--device",
    "--evaluate",
    "--no-evaluate",
    "--backend",
    "--checkpoint-every-s",
    "--checkpoint-every-frames",
    "--memory-gb",
    "--watch",
    "--watch-host",
    "--watch-port",
    "--watch-stays",
    "--no-watch-stays",
)


@dataclass(frozen=True, kw_only=True)
class MapOptions(WatchOptions, SettingsOptions):
    """Map a sequence online, optimise over its keyframes, and score it. Writes maps, numbers and a
    report to a folder.

    Every setting of the chosen system is an option.
    """

    data: Annotated[str, tyro.conf.Positional] = ""
    """Folder of a sequence, or "room" for the built-in scene."""
    out: str = ""
    """New or empty folder for the results; runs/<name>-<time> by default."""
    format: str = named("auto", layout_names)
    """Layout of the data."""
    reader: tuple[str, ...] = ()
    """Options of the layout's reader, name=value: register=true (7-Scenes), undistort=false (TUM),
    split=train (ScanNet++), poses=false (folder, TUM), n_frames=480, rooms=64 or
    moved=chair (room)."""
    extra: tuple[str, ...] = ()
    """Further images of the frames, NAME=PATTERN of files in the folder of the recording:
    class=labels/{index:06d}.png or class=labels/{stem}.png, by the number of the frame or the name
    of its colour image. A seeding rule and a system of your own see them, and extra.npz has the
    label, or the mean of the image, of each Gaussian."""
    from_gaussians: str = ""
    """File of Gaussians that the map begins with (.ply), in metres, in the world frame of the
    recording's poses; they are optimised with the new ones. GSFusion only."""
    onto: str = ""
    """Folder of a finished run: the camera is located in its map, and mapping goes on in a copy of
    it, with that run's settings and tracked poses. That run stays as it is."""
    keep_moved: bool = False
    """With --onto: leave surfaces in the map that the recording sees through, because something
    moved."""
    resume: str = ""
    """Folder of an interrupted run to continue; no other option is needed, but --seeding.rule or
    --system if its rule or its system came from a file, which is executed."""
    evaluate: bool = True
    """Score mapped and held-out views and write the report."""
    checkpoint_every_s: float = 30.0
    """Save the state of the run this often, seconds, so that --resume can continue after the
    process was killed; less often if saving takes more than 3 % of the time. 0: only when the run
    is interrupted."""
    checkpoint_every_frames: int = 0
    """Also save after every n-th frame. 0: no."""
    estimate_memory: bool = False
    """Only say how much memory the map will need; reads up to 200 frames and maps 8."""
    memory_gb: float = 0.0
    """Keep the map in temporary files, and what is far from the camera out of memory, so that the
    process needs about this many GB; the map is the same. On a processor only. 0: keep it in
    memory."""


def run(arguments: list[str]) -> int:
    """Run ``gsfusion-nb map ARGUMENTS``. Returns the exit status.

    Raises:
        ValueError, KeyError, OSError: invalid options, or data that cannot be mapped.
    """
    options = parse(MapOptions, "gsfusion-nb map", arguments, data="data")
    from ..data import open_sequence
    from ..runs import CheckpointEvery, run_mapping

    every = CheckpointEvery(
        seconds=options.checkpoint_every_s, frames=options.checkpoint_every_frames
    )
    if options.memory_gb and options.device != "cpu":
        raise ArgumentError(
            "--memory-gb is for maps on a processor; leave it out, or take --device cpu"
        )
    MAP_MEMORY.limit(options.memory_gb or None)
    with use_backend(options.backend):
        options.check_device()
        if options.resume:
            _refuse_more(options, arguments)
            with options.tab() as tab:
                return options.print_and_stay(_continue_run(options, arguments, every, tab), tab)
        if not options.data:
            raise ArgumentError(
                "expected the folder of a sequence or the name of a built-in scene: gsfusion-nb "
                "map room"
            )
        settings = options.settings()
        data, reader = recording_to_open(options, options.data)
        if data != options.data and reader.get("poses") is False:
            settings = replace(settings, tracking__poses="tracked")
        if options.extra:
            reader["extra"] = patterns_of(options.extra)
        if options.estimate_memory:
            memory_gb = memory_needed_gb(
                open_sequence(data, data=settings.data, **reader), settings
            )
            parts = ", ".join(f"{gb:.2g} GB {what}" for what, gb in memory_gb.items())
            print(
                f"about {sum(memory_gb.values()):.2g} GB: {parts}; "
                "--memory-gb keeps the map in files"
            )
            return 0
        if options.said_of_preset():
            print(options.said_of_preset())
        with options.tab() as tab:
            finished_run = run_mapping(
                data,
                settings,
                folder=options.out or None,
                device=options.device,
                evaluate=options.evaluate,
                checkpoints=every,
                from_gaussians=options.from_gaussians or None,
                onto=options.onto or None,
                keep_moved=options.keep_moved,
                watch=tab,
                **reader,
            )
            return options.print_and_stay(finished_run, tab)


def patterns_of(texts: Sequence[str]) -> dict[str, str]:
    """``NAME=PATTERN`` texts as a dictionary.

    Raises:
        ValueError: a text without a name or a pattern, or a name twice.
    """
    patterns = dict[str, str]()
    for text in texts:
        name, _, pattern = text.partition("=")
        if not (name and pattern):
            raise ArgumentError(f"expected further images as NAME=PATTERN, got {shown(text)}")
        if name in patterns:
            raise ArgumentError(f"the further image {shown(name)} was named twice")
        patterns[name] = pattern
    return patterns


def _continue_run(
    options: MapOptions,
    arguments: list[str],
    every: "CheckpointEvery",
    tab: "BrowserTab | None",
) -> "FinishedRun":
    """Continue a run; the files of its rule and its system are executed only if they were named, or
    if the user allows it now."""
    from ..runs import resume_mapping

    def resume(named: dict[str, str]) -> "FinishedRun":
        return resume_mapping(
            options.resume,
            seeding=named.get("rule"),
            system=named.get("system"),
            device=options.device,
            evaluate=options.evaluate,
            checkpoints=every,
            watch=tab,
        )

    texts = {"rule": options.config.seeding.rule, "system": options.system}
    named = {kind: text for kind, text in texts.items() if is_code_file(text)}
    while True:
        try:
            return resume(named)
        except CodeNotNamedError as e:
            naming = (_NAMING[e.kind], *e.code)
            ask_or_refuse(e, "gsfusion-nb map", arguments, naming)
            arguments = [*arguments, *naming]
            named[e.kind] = e.code[0]


def _refuse_more(options: MapOptions, arguments: list[str]) -> None:
    """A resumed run has its own settings and data: raise ``ValueError`` if others are given."""
    more = [a for a in arguments if a.startswith("-") and a.split("=")[0] not in _WITH_RESUME]
    if "--system" in {a.split("=")[0] for a in arguments} and not is_code_file(options.system):
        more.append("--system")
    if more or options.data:
        raise ArgumentError(
            f"--resume continues with the run's own settings and data; leave out {options.data} "
            f"{' '.join(more)}"
        )


_COUNTED_VIEWS = 200
_TRIAL = 8
"""Frames of which the blocks are counted, and frames that are mapped, both evenly spread."""
_PROCESS_GB = 0.6
"""Of a process without a map."""
_COPIES = 1.1
"""Copies of the voxel blocks that a run makes at its end, while it writes and scores them; 0.8 to
1.1 were measured."""
_BYTES_PER_TRIANGLE = 130
"""What a mesh takes while it is made, with its edges and vertices; 100 to 140 were measured."""


def memory_needed_gb(sequence: "OpenedSequence", config: "SystemConfig") -> dict[str, float]:
    """The memory that the map of a recording will need, GB, by what takes it.

    The voxel blocks that some frames see are counted, without their voxels. A few frames are
    mapped, and the whole map is taken to have as many Gaussians and triangles a block as that map.
    Every frame counts as a keyframe, so that pictures are an upper bound. A system without a TSDF
    makes one for its mesh, which counts as part of it.

    Args:
        sequence: The recording.
        config: Settings of the run.

    Raises:
        SequenceError: the recording has no poses.
    """
    from ..errors import SequenceError
    from ..mapping import make_mapper
    from ..runs.mapped_views import evenly
    from ..runs.mapping_run import has_poses
    from ..runs.poses_in_map import readable_frames
    from ..tsdf import TsdfVolume
    from ..tsdf.allocate import new_band_blocks

    frames = sequence.mapping
    n = len(sequence.mapping)
    if not has_poses(frames):
        raise SequenceError(
            f"{sequence.name} has no poses, so what its frames see together is not known beforehand"
        )
    mapper = make_mapper(replace(config, tracking__poses="given"))
    settings = getattr(config, "tsdf", None)
    has_volume = settings is not None
    if settings is None:
        settings = TsdfConfig(voxel_size_m=getattr(config, "mesh_voxel_m", 0.04))
    whole = TsdfVolume(settings)
    part = TsdfVolume(settings)

    def view(limit: int) -> "FrameSubset":
        return dataclasses.replace(
            frames, positions=[frames.positions[i] for i in evenly(n, limit)]
        )

    for frame in readable_frames(view(_COUNTED_VIEWS)):
        whole.index.add(new_band_blocks(whole, frame))
    for frame in readable_frames(view(_TRIAL)):
        part.index.add(new_band_blocks(part, frame))
        mapper.step(frame)
    columns = mapper.gaussians.columns.values()
    share = whole.n_blocks / max(1, part.n_blocks)
    pixels = sequence.camera.width * sequence.camera.height
    mesh = mapper.mesh()
    mesh_gb = share * len(mesh.faces) * _BYTES_PER_TRIANGLE / 1e9
    volume_gb = estimate_memory(whole.n_blocks, weighs_colours=whole.config.weighs_colours) / 1e9
    return {
        "voxel blocks": volume_gb if has_volume else 0.0,
        "the blocks while they are written": _COPIES * volume_gb if has_volume else 0.0,
        "Gaussians": share * sum(column.nbytes for column in columns) / 1e9,
        "mesh": mesh_gb + (0.0 if has_volume else volume_gb),
        "pictures, at most": n * pixels * (3 + 4) / 1e9,
        "process": _PROCESS_GB,
    }
