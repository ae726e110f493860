"""The findings of a check-up: one per property examined, with its numbers and its repair."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from ...config import DataConfig, RepairConfig

Verdict = Literal["ok", "unknown", "doubtful", "wrong"]
RANK: dict[Verdict, int] = {"ok": 0, "unknown": 1, "doubtful": 2, "wrong": 3}
"""What cannot be known from the recording is no trouble, but it is not in order either: it is "unknown"."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One property that was examined."""

    name: str
    """What was examined, for example "depth scale"."""
    verdict: Verdict
    sentence: str
    """What was found, with the numbers that matter."""
    numbers: Mapping[str, float] = field(default_factory=dict)
    """Measured numbers; the unit is part of the name."""
    repair: str = ""
    """Options of ``gsfusion-nb map``, or what to do; empty if nothing needs to be done."""


def flags_of(data: DataConfig) -> str:
    """The options of ``gsfusion-nb map`` for this range, these depth limits and these corrections."""
    default = DataConfig()
    names = ("start", "stop", "depth_min_m", "depth_max_m")
    words = [
        f"--data.{name.replace('_', '-')} {getattr(data, name):.6g}"
        for name in names
        if getattr(data, name) != getattr(default, name)
    ]
    return " ".join([*words, *([data.repair.flags] if data.repair != RepairConfig() else [])])
