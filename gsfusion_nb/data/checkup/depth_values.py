"""What the depth images hold: how much is missing, codes that mean "missing", how far things are."""

from collections.abc import Sequence as Rows
from dataclasses import dataclass

import torch

from .findings import Finding
from .sample import FrameFacts

_CODE_SHARE = 5e-4
"""A value that fills this share of the valid pixels, alone at the end of the range, is a code."""
_CODE_GAP = 1.3
"""How many times the 99th percentile of the other depths it must be."""
_MANY_MISSING, _MOST_MISSING = 0.5, 0.85


@dataclass(frozen=True, kw_only=True)
class DepthCode:
    """A depth that stands for "missing"."""

    value_m: float
    share: float
    """Of all valid pixels."""
    high: bool
    """At the far end of the range, else at the near one."""


def find_codes(frames: Rows[FrameFacts]) -> list[DepthCode]:
    """Values at either end of the range that many pixels share and that are far from all others."""
    values = torch.cat([f.depth_m[f.depth_m > 0] for f in frames]) if frames else torch.zeros(0)
    found = []
    for high in (True, False):
        if len(values) < 1000:
            break
        end = values.max() if high else values.min()
        at_end = (values - end).abs() <= 1e-5 * end
        share = float(at_end.float().mean())
        others = values[~at_end]
        if share < _CODE_SHARE or not len(others):
            continue
        rest = _percentile(others, 0.99 if high else 0.01)
        if (float(end) > _CODE_GAP * rest) if high else (_CODE_GAP * float(end) < rest):
            found.append(DepthCode(value_m=float(end), share=share, high=high))
            values = others
    return found


def clear_codes(frames: Rows[FrameFacts], codes: Rows[DepthCode]) -> None:
    """Set pixels with a code to missing, in place."""
    for frame in frames:
        for code in codes:
            frame.depth_m[(frame.depth_m - code.value_m).abs() <= 1e-5 * code.value_m] = 0.0
        frame.missing = float((frame.depth_m <= 0).float().mean())


def code_finding(codes: Rows[DepthCode], depth_scale: float | None, repair: str) -> Finding:
    """Whether there are codes besides 0."""
    if not codes:
        return Finding(name="depth codes", verdict="ok", sentence='No value but 0 stands for "missing".')
    parts = []
    for code in codes:
        stored = f"{code.value_m * depth_scale:.0f}, read as " if depth_scale else ""
        parts.append(
            f"{code.share:.1%} of the pixels with depth hold {stored}{code.value_m:.4g} m, far from all other depths"
        )
    return Finding(
        name="depth codes",
        verdict="wrong",
        repair=repair,
        numbers={"share": sum(c.share for c in codes), "value_m": codes[0].value_m},
        sentence=f'{"; ".join(parts)}: a code for "missing", not a distance.',
    )


def missing_finding(frames: Rows[FrameFacts]) -> Finding:
    """How much depth there is."""
    shares = sorted(f.missing for f in frames)
    middle, most = shares[len(shares) // 2], shares[-1]
    values = torch.cat([f.depth_m[f.depth_m > 0] for f in frames])
    near, median, far = (_percentile(values, q) for q in (0.01, 0.5, 0.99))
    numbers = {"missing_median": middle, "missing_most": most, "near_m": near, "median_m": median, "far_m": far}
    text = (
        f"{middle:.0%} of the pixels have no depth (at most {most:.0%} in a frame); depths {near:.2f} to {far:.2f} m, "
        f"median {median:.2f} m"
    )
    if middle > _MANY_MISSING:
        return Finding(
            name="depth coverage",
            verdict="wrong" if middle > _MOST_MISSING else "doubtful",
            numbers=numbers,
            sentence=f"{text}.",
            repair="record within the sensor's range and avoid sun, glass and black surfaces; maps will have holes",
        )
    return Finding(name="depth coverage", verdict="ok", numbers=numbers, sentence=f"{text}.")


def _percentile(values: torch.Tensor, q: float) -> float:
    some = values[:: max(1, len(values) // 200_000)]
    return float(torch.quantile(some.double(), q)) if len(some) else float("nan")
