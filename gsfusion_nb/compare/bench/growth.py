"""Whether a step takes longer as the map grows."""

from collections.abc import Iterator

import numpy as np

from ...config import replace
from ...data.room import RoomSequence
from ...errors import ArgumentError
from ...mapping import get_system
from ...resources import PeakMemory
from .options import BenchOptions, BenchRow
from .timing import Lap, lap, summary

ROOMS = 64
ROOM_SIZE = (160, 120)
ROOM_FRAMES = 20
"""Rooms of the building of ``growth``; size and number of the images of each."""
_GROWTH_VOXEL_M = 0.04


def growth_rows(options: BenchOptions) -> Iterator[BenchRow]:
    """A square building of equal rooms through which the camera walks, room by room: the mean time
    of a frame in each.

    Rooms 1, 2, 3 to 4, 5 to 8 and so on have a row, the median of these rooms. The last row of a
    system has the exponent b of  time = a rooms^b  by least squares over all rooms, in its note and
    its values. It is 0 if the size of the map does not matter.
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
    for name in options.system:
        system = get_system(name)
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
        rooms = np.arange(1, n_rooms + 1)
        exponent, _ = np.polyfit(np.log(rooms), np.log([x.cpu_s for x in laps]), 1)
        yield _growth_row(case, name, len(mapper.gaussians), laps, float(exponent), memory.peak_mb)


def _growth_row(
    case: str,
    name: str,
    n: int,
    laps: list[Lap],
    exponent: float | None = None,
    peak_mb: float | None = None,
) -> BenchRow:
    """The row of the later half of ``laps``, those of the rooms since the row before; the last row
    of a system has an exponent and its memory."""
    half = len(laps) // 2
    case = f"{case} {half + 1} to {len(laps)}"
    note = f"{n / 1e3:.1f}k"
    values: dict[str, float] = {"n_gaussians": n}
    if exponent is not None:
        note += f", exponent {exponent:.2f}"
        values["exponent"] = exponent
    return BenchRow(
        section="growth",
        case=case,
        method=name,
        timing=summary(laps[half:], peak_mb),
        note=note,
        values=values,
    )
