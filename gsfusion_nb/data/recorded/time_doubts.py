"""Why times that are taken as seconds may be none."""

import logging
from collections import abc
from dataclasses import dataclass
from pathlib import Path

from .stamps import counter_reason, date_unit, median_step

log = logging.getLogger(__name__)


USUAL_STEPS_S = (1 / 130, 1.0)
"""People film with 1 to 120 frames a second; 130, since whole milliseconds are rounded."""

_UNITS_S = {"ms": 1e-3, "us": 1e-6, "minutes": 60.0, "hours": 3600.0}
"""Units in which somebody may have written times, in seconds."""


@dataclass(frozen=True)
class DoubtfulTimes:
    """Why the times of frames may not be seconds."""

    sentence: str
    remedy: str
    """What to do if they are not."""


def doubt_on_times(
    times_s: abc.Sequence[float], *, if_counted: str, name: str
) -> DoubtfulTimes | None:
    """A doubt on times that are taken as seconds; None where nothing speaks against them.

    A date is never doubted, since its size fixes its unit.

    Args:
        times_s: Of all frames, in any order.
        if_counted: What to do if they number the frames.
        name: Of the file that holds them.
    """
    in_order = sorted(times_s)
    step = median_step(in_order)
    if step <= 0 or date_unit(in_order[-1]):
        return None
    least, most = USUAL_STEPS_S
    beginning = f"as seconds they would be one frame in {step:.3g} s"
    if step >= most and counter_reason(in_order, is_padded=False):
        return DoubtfulTimes(
            f"{beginning}, but they are whole numbers, as those are that count frames, from "
            f"{in_order[0]:g} to {in_order[-1]:g}",
            f"if they number the frames: {if_counted}",
        )
    if least <= step <= most:
        return None
    sentence = f"{beginning}, but what people film has 1 to 120 frames a second"
    unit = next(
        (unit for unit, unit_s in _UNITS_S.items() if least <= step * unit_s <= most),
        "",
    )
    if not unit:
        return DoubtfulTimes(sentence, f"write seconds into {name}, or, without: {if_counted}")
    unit_s = _UNITS_S[unit]
    change = f"multiply them by {unit_s:g}" if unit_s > 1 else f"divide them by {1 / unit_s:g}"
    return DoubtfulTimes(
        f"{sentence}; in {unit} it would be one in {step * unit_s:.3g} s",
        f"if {name} holds {unit}: {change}",
    )


def warn_of_doubt(
    file: Path, times_s: abc.Sequence[float], *, if_counted: str
) -> DoubtfulTimes | None:
    """``doubt_on_times`` on those of ``file``, which a warning names."""
    doubt = doubt_on_times(times_s, if_counted=if_counted, name=file.name)
    if doubt is not None:
        log.warning("%s: %s; %s", file, doubt.sentence, doubt.remedy)
    return doubt
