"""``times.txt``: when each image was taken, as converted recordings keep it."""

import logging
import math
from pathlib import Path

from ...errors import shown
from ..sequence import SequenceError
from .pose_lines import image_key
from .poses import read_words

log = logging.getLogger(__name__)

TIMES = "times.txt"


def times_of_images(path: Path, images: list[Path]) -> list[float] | None:
    """Seconds of each image by its name, from lines "name seconds"; ``None`` without such a file, or if it knows none.

    Raises:
        SequenceError: a line that is not a name and a number, or an image that is not in the file.
    """
    if not path.is_file():
        return None
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
        return None  # converted from a recording without times
    late = next((image for image, a, b in zip(images[1:], times, times[1:], strict=False) if b <= a), None)
    if late is not None:
        log.warning("%s: the time of %s is not after that of the image before it", path, late.name)
    return times
