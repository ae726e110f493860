"""Go on in the map of a finished run with frames that arrive over time."""

from collections.abc import Callable, Iterable
from pathlib import Path

import torch

from ..config import SystemConfig
from ..data import Sequence
from ..data.stream import Policy
from ..mapping import Mapper
from ..mapping.moved_surfaces import MovedSurfaces
from ..seeding import SeedingRule
from ..types import Frame
from .onto import mapper_onto, named_system, read_parent, settings_onto
from .stream_run import StreamRun


def stream_onto(
    frames: Iterable[Frame] | Sequence,
    parent: Path | str,
    config: SystemConfig | None = None,
    *,
    system: str | type[Mapper] = "gsfusion",
    seeding: "str | SeedingRule | None" = None,
    device: torch.device | str = "cpu",
    keep_moved: bool = False,
    policy: Policy | None = None,
    until: Callable[[], bool] = lambda: False,
) -> StreamRun:
    """A run that looks for a camera in the map of a finished run, and goes on in a copy of it.

    ``map_stream`` and ``LiveMapper`` take it. Frames before the first that is located are not
    mapped. The files of the finished run stay as they are. The images may come from another camera,
    and have another size.

    Args:
        frames: Any iterable of frames, for example a ``LiveSource``; used once.
        parent: Folder of the finished run.
        config: Settings; by default those of that run, with tracked poses.
        system: "FILE.py:Name", or its class, of a run whose system came from a file.
        seeding: As for ``run_mapping``.
        device: Device of the maps.
        keep_moved: Leave surfaces in the map that the camera sees through.
        policy, until: As for ``StreamRun``.

    Raises:
        FileNotFoundError: no such run, or one of a version that did not keep its state.
        ValueError: a file is damaged, or the settings do not belong to the map.
    """
    earlier_run = read_parent(parent, named_system(config, system))
    settings = config or settings_onto(earlier_run.config)
    mapper = mapper_onto(earlier_run, settings, seeding=seeding, device=device)
    run = StreamRun(frames, mapper, policy=policy, until=until, parent=earlier_run.as_json)
    run.moved = MovedSurfaces(mapper, keeps=keep_moved)
    return run
