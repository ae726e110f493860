"""``times.txt``: when each image was taken, as converted recordings keep it."""

import logging
import math
from pathlib import Path

from ...errors import shown
from ..sequence import SequenceError
from .pose_lines import image_key
from .poses import read_words
from .stamps import judge_stamps

log = logging.getLogger(__name__)

TIMES = "times.txt"


def times_of_images(path: Path, images: list[Path]) -> tuple[list[float] | None, str]:
    """Seconds of each image by its name, from lines "name seconds"; or ``None`` and the reason why there are none.

    Numbers that are not times (``stamps.judge_stamps``) are not used.

    Raises:
        SequenceError: a line that is not a name and a number, or an image that is not in the file.
    """
    if not path.is_file():
        return None, f"there is no {path.name}"
    time_of: dict[str, float] = {}
    for number, words in read_words(path, "lines 'name seconds'"):
        if words == ["frame", "time_s"]:
            continue
        try:
            name, value = words
            time_of[image_key(name)] = float(value)
        except ValueError:
            raise SequenceError(f"{path} line {number} must be 'name seconds', got {shown(' '.join(words))}") from None
    lacking = [image for image in images if image_key(image.stem) not in time_of]
    if lacking:
        raise SequenceError(f"{path} has no time of {lacking[0]}; expected one per image")
    times = [time_of[image_key(image.stem)] for image in images]
    if not all(math.isfinite(t) for t in times):
        return None, f"{path.name} holds none"  # converted from a recording without times
    stamps = judge_stamps(times, unit="s")
    if stamps.times_s is None:
        log.warning(
            "%s: its numbers are not times: %s; frames are taken in the order of their names", path, stamps.why_not
        )
        return None, f"the numbers of {path.name} are not times: {stamps.why_not}"
    late = next((image for image, a, b in zip(images[1:], times, times[1:], strict=False) if b <= a), None)
    if late is not None:
        log.warning("%s: the time of %s is not after that of the image before it", path, late.name)
    return times, ""
