"""The values of the depth images: missing pixels, codes that mean "missing", range of depths."""

from collections import abc
from dataclasses import dataclass

import torch

from .findings import Finding
from .sample import FrameFacts

_CODE_SHARE = 5e-4
"""A value at the end of the range with this share of the valid pixels, far from all others, is a code."""
_CODE_GAP = 1.3
"""A code at the far end is at least this many times the 99th percentile of the other depths."""
_MANY_MISSING, _MOST_MISSING = 0.5, 0.85


@dataclass(frozen=True, kw_only=True)
class DepthCode:
    """A depth value that means "missing"."""

    value_m: float
    share: float
    """Share of all valid pixels."""
    high: bool
    """Whether it is at the far end of the range; else it is at the near end."""


def find_codes(frames: abc.Sequence[FrameFacts]) -> list[DepthCode]:
    """Values at either end of the range that many pixels have and that are far from all others."""
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


def clear_codes(frames: abc.Sequence[FrameFacts], codes: abc.Sequence[DepthCode]) -> None:
    """Set pixels with a code to missing, in place."""
    for frame in frames:
        for code in codes:
            frame.depth_m[(frame.depth_m - code.value_m).abs() <= 1e-5 * code.value_m] = 0.0
        frame.missing = float((frame.depth_m <= 0).float().mean())


def code_finding(codes: abc.Sequence[DepthCode], depth_scale: float | None, repair: str) -> Finding:
    """Finding: are there codes besides 0?"""
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


def missing_finding(frames: abc.Sequence[FrameFacts]) -> Finding:
    """Finding: how much depth is missing?"""
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
            repair=(
                "maps will have holes; when recording, stay within the sensor's range and avoid sunlight, glass and "
                "black surfaces"
            ),
        )
    return Finding(name="depth coverage", verdict="ok", numbers=numbers, sentence=f"{text}.")


def _percentile(values: torch.Tensor, q: float) -> float:
    some = values[:: max(1, len(values) // 200_000)]
    return float(torch.quantile(some.double(), q)) if len(some) else float("nan")
