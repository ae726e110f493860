"""``gsfusion-nb live``: map what a camera sees, or a folder that another program is writing."""

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from ..backends import use_backend
from ..checks import check_name
from ..data.stream import GrowingFolder, LiveSource, RealSense
from ..errors import ArgumentError
from .options import HELP, print_names
from .settings import SettingsOptions, parse
from .watch import WatchOptions

if TYPE_CHECKING:
    from ..runs import FinishedRun, StreamRun
    from ..viz import BrowserTab

_ABOUT = """Map frames as they arrive. Ctrl-C ends the scan; then the report is written.

Every setting is an option, as in gsfusion-nb map:
gsfusion-nb live folder scan --tsdf.voxel-size-m 0.02 --data.width 320

All options of a source: gsfusion-nb live folder --help"""


@dataclass(frozen=True, kw_only=True)
class LiveOptions(WatchOptions, SettingsOptions):
    """Options of all sources."""

    out: str = ""
    """New or empty folder for the results; runs/<name>-<time> by default."""
    policy: Literal["", "all", "latest"] = ""
    """What happens if mapping is slower than the camera. all: the source waits; latest: only the
    newest frame waits, older ones are dropped. Default: latest for cameras, all for folders."""
    onto: str = ""
    """Folder of a finished run: the camera is looked for in its map. From the first frame that is
    located on, mapping goes on in a copy of it, with that run's settings and tracked poses. That
    run stays as it is."""
    keep_moved: bool = False
    """With --onto: leave surfaces in the map that the camera sees through, because something
    moved."""
    frames: int = 0
    """End after this many frames; 0: continue until the source ends or Ctrl-C."""
    evaluate: bool = True
    """Score the frames that were kept and write the report."""
    checkpoint_every_s: float = 30.0
    """Save the state of the scan this often, seconds, so that the map is kept if the process is
    killed; less often if saving takes more than 3 % of the time. 0: never."""

    def source(self) -> LiveSource:
        """The source of the frames."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class FolderOptions(LiveOptions):
    """Map a folder in the plain layout while another program is writing it. Ctrl-C ends the
    scan."""

    path: Annotated[str, tyro.conf.Positional]
    """The folder: rgb/, depth/, intrinsics.json, and poses.txt, whose line k belongs to the image
    of number k."""
    poses: bool = True
    """--no-poses: there is no poses.txt; the camera is tracked."""
    idle_s: float = 10.0
    """End when nothing has changed for this long, seconds."""
    patience_s: float = 3.0
    """Skip a frame that is still incomplete after this long, seconds."""
    stop_file: str = "stop"
    """Name of the file in the folder that ends the recording."""

    def source(self) -> LiveSource:
        """The folder, followed."""
        return GrowingFolder(
            self.path,
            poses=self.poses,
            idle_s=self.idle_s,
            patience_s=self.patience_s,
            stop_file=self.stop_file,
        )


@dataclass(frozen=True, kw_only=True)
class RealSenseOptions(LiveOptions):
    """Map what an Intel RealSense camera sees; its poses are tracked. Ctrl-C ends the scan."""

    width: int = 640
    """Width of the colour and depth images, pixels."""
    height: int = 480
    """Height of the colour and depth images, pixels."""
    fps: int = 30
    """Frames per second."""
    serial: str = ""
    """Serial number of the camera; needed if several are connected."""
    warm_up: int = 30
    """Number of frames to skip at the start, while the camera adapts its exposure."""

    def source(self) -> LiveSource:
        """The camera."""
        names = ("width", "height", "fps", "serial", "warm_up")
        return RealSense(**{name: getattr(self, name) for name in names})


SOURCES: dict[str, Any] = {"folder": FolderOptions, "realsense": RealSenseOptions}


def run(arguments: list[str]) -> int:
    """Run ``gsfusion-nb live ARGUMENTS``. Returns the exit status."""
    if not arguments or arguments[0] in HELP:
        print_names(
            "gsfusion-nb live", _ABOUT, {name: source.__doc__ for name, source in SOURCES.items()}
        )
        return 0
    options = _options(arguments)
    with options.tab() as tab:
        return options.print_and_stay(_map(options, tab), tab)


def live(arguments: list[str]) -> "FinishedRun":
    """Map what comes from the source that ``arguments`` name.

    Raises:
        ValueError, KeyError, OSError: invalid options, or a source that cannot be opened.
    """
    options = _options(arguments)
    with options.tab() as tab:
        return _map(options, tab)


def _options(arguments: list[str]) -> LiveOptions:
    name = arguments[0] if arguments else ""
    check_name("live source", name, SOURCES)
    return parse(SOURCES[name], f"gsfusion-nb live {name}", arguments[1:])


def _map(options: LiveOptions, tab: "BrowserTab | None") -> "FinishedRun":
    from ..runs import CheckpointEvery, map_stream

    with use_backend(options.backend):
        options.check_device()
        return map_stream(
            _run(options),
            folder=options.out or None,
            evaluate=options.evaluate,
            on_stop="finish",
            checkpoints=CheckpointEvery(seconds=options.checkpoint_every_s),
            watch=tab,
        )


def _run(options: LiveOptions) -> "StreamRun":
    """The run of the source's frames, in a map of its own or in that of ``--onto``."""
    from ..mapping import make_mapper
    from ..runs import StreamRun, stream_onto

    source = options.source()
    settings = _settings(options, source)
    policy: Any = options.policy or None
    if options.onto:
        return stream_onto(
            source,
            options.onto,
            settings,
            device=options.device,
            keep_moved=options.keep_moved,
            policy=policy,
        )
    if options.keep_moved:
        raise ArgumentError("--keep-moved is for --onto RUN, in whose map something may have moved")
    return StreamRun(source, make_mapper(settings, device=options.device), policy=policy)


def _settings(options: LiveOptions, source: LiveSource) -> Any:
    """The settings, with tracking where the source has no poses, and with the limit ``frames``."""
    config = options.settings()
    if not source.has_poses:
        config = dataclasses.replace(
            config, tracking=dataclasses.replace(config.tracking, poses="tracked")
        )
    if options.frames:
        config = dataclasses.replace(
            config, data=dataclasses.replace(config.data, stop=options.frames)
        )
    return config
