"""Findings from frame to frame: jumps, poses that do not move, exposure, blur, frozen images."""

import itertools
from collections import abc

import numpy as np

from .findings import Finding
from .frame_to_frame import OverFrames

_JUMP_BASE_DEG, _JUMP_BASE_M = 1.0, 0.03
"""Shorter steps are not jumps."""
_JUMP_OF_MEDIAN = 1.5
"""A jump is longer than this many times the median of the steps around, ..."""
_JUMP_ERROR, _JUMP_ERROR_OF_USUAL = 0.01, 4.0
"""... and depth then differs by this share and this many times the usual difference; the worst of 250 steps of a
hand-held Kinect differs by 0.6 per cent, twice the usual."""
_JUMP_UNSEEN = 4.0
"""If two frames have nothing in common, a step is a jump if it is at least this many times the median."""
STEP_STOPS, SPREAD_STOPS = 0.3, 1.0
"""Changes of brightness that are reported, log2: between neighbours (a hand-held Kinect with automatic exposure: 0.19
at most), and between frames up to 30 apart (the same: 0.68)."""
FIT_STOPS = 0.15
"""From this difference within 30 frames on, fitted exposures gain: 0.7 dB at 0.19, nothing at 0.01."""
_BLURRED = 0.3
"""Share of the neighbours' sharpness below which a frame is blurred; the worst of 250 frames of a hand-held Kinect has
0.38."""
_STILL_DEG, _STILL_M = 0.1, 0.002
_NAMED = 12
"""Largest number of frames that a finding names."""


def find_jumps(over: OverFrames) -> tuple[list[int], list[int]]:
    """Frames far from both neighbours, and frames after which the path continues at another place."""
    step = np.maximum(over.turned_deg / _JUMP_BASE_DEG, over.moved_m / _JUMP_BASE_M)
    usual_error = float(np.nanmedian(over.error)) if np.isfinite(over.error).any() else 0.0
    frozen = over.same_depth | np.roll(over.same_depth, 1)  # there depth cannot confirm poses
    jumps = set()
    for i in np.flatnonzero(np.isfinite(step)):
        around = step[max(0, i - 10) : i + 11]
        times = step[i] / max(np.nanmedian(around), 1e-9)
        disagrees = over.error[i] > max(_JUMP_ERROR, _JUMP_ERROR_OF_USUAL * usual_error) and times > _JUMP_OF_MEDIAN
        unseen = np.isnan(over.error[i]) and times > _JUMP_UNSEEN
        if step[i] > 1 and (disagrees or unseen) and not frozen[i]:
            jumps.add(int(i))
    alone = sorted(int(over.number[i + 1]) for i in jumps if i + 1 in jumps)
    cuts = sorted(int(over.number[i]) for i in jumps if i + 1 not in jumps and i - 1 not in jumps)
    return alone, cuts


def jump_finding(over: OverFrames, alone: abc.Sequence[int], cuts: abc.Sequence[int], repair: str) -> Finding:
    """Finding: do the poses jump where the depth images do not?"""
    turned, moved = (float(np.nanmax(x)) if np.isfinite(x).any() else 0.0 for x in (over.turned_deg, over.moved_m))
    numbers = {"largest_turn_deg": turned, "largest_step_m": moved, "jumps": float(len(alone) + len(cuts))}
    extent = f"steps of at most {turned:.1f} degrees and {100 * moved:.1f} cm"
    if not alone and not cuts:
        return Finding(name="pose jumps", verdict="ok", numbers=numbers, sentence=f"The path is continuous: {extent}.")
    parts = [f"frame {_list(alone)} is off the path of its neighbours"] * bool(alone)
    parts += [f"the path is interrupted after frame {_list(cuts)}"] * bool(cuts)
    return Finding(
        name="pose jumps",
        verdict="wrong",
        numbers=numbers,
        repair=repair,
        sentence=f"{' and '.join(parts).capitalize()} ({extent}), but the depth images do not change with it.",
    )


def longest_piece(cuts: abc.Sequence[int], length: int) -> tuple[int, int]:
    """First and one past the last frame of the longest piece between cuts (a cut lies after its frame)."""
    ends = [0, *(c + 1 for c in cuts), length]
    return max(itertools.pairwise(ends), key=lambda piece: piece[1] - piece[0])


def motion_finding(over: OverFrames) -> Finding | None:
    """Finding if the poses do not move; else None."""
    if not np.isfinite(over.turned_deg).any() or len(over.number) < 3:
        return None
    if np.nansum(over.turned_deg) > 1 or np.nansum(over.moved_m) > 0.02:
        return None
    still = bool(over.same_colour[:-1].all())
    return Finding(
        name="pose motion",
        verdict="doubtful" if still else "wrong",
        repair="" if still else "give a trajectory that belongs to this recording",
        sentence="All poses are the same"
        + (", and so are the images: nothing can be checked." if still else ", but the images differ."),
    )


def exposure_finding(over: OverFrames, far_gains: np.ndarray) -> Finding:
    """Finding: do the same points keep their brightness?"""
    known = np.isfinite(over.gain_stops)
    step = float(np.abs(over.gain_stops[known]).max(initial=0.0))
    spread = float(np.nanmax(np.abs(far_gains), initial=0.0))
    numbers = {"largest_step_stops": step, "largest_difference_stops": spread}
    text = (
        f"the brightness of the same points differs by at most {step:.2f} stops from frame to frame and {spread:.2f} "
        "within 30 frames"
    )
    if step < STEP_STOPS and spread < SPREAD_STOPS:
        hint = "; map with --optim.fit-exposure" if spread > FIT_STOPS else ""
        return Finding(name="exposure", verdict="ok", numbers=numbers, sentence=f"{text.capitalize()}{hint}.")
    worst = over.number[known][np.argsort(-np.abs(over.gain_stops[known]))][:3]
    return Finding(
        name="exposure",
        verdict="doubtful",
        numbers=numbers,
        repair=(
            "map with --optim.fit-exposure, or the map will show stripes of different brightness; lock exposure and "
            "white balance when recording"
        ),
        sentence=f"{text.capitalize()}, most after frame {_list(sorted(worst.tolist()))}.",
    )


def exposure_unknown() -> Finding:
    """The finding where the colour images are those of other frames, so no point can be found again in two of them."""
    text = "Cannot be known before each colour image is paired with its depth image."
    return Finding(name="exposure", verdict="unknown", sentence=text)


def blurred_frames(over: OverFrames) -> list[int]:
    """Frames that are much less sharp than their neighbours."""
    return [int(p) for p, s in zip(over.number, over.sharpness, strict=True) if s < _BLURRED]


def frozen_frames(over: OverFrames) -> list[int]:
    """Frames whose colour or depth image is that of the previous frame, although the pose has changed."""
    moved = (over.turned_deg > _STILL_DEG) | (over.moved_m > _STILL_M)
    return [int(over.number[i + 1]) for i in np.flatnonzero((over.same_colour | over.same_depth) & moved)]


def sharpness_finding(over: OverFrames, blurred: abc.Sequence[int], repair: str) -> Finding:
    """Finding: are single frames blurred?"""
    numbers = {"least_relative_sharpness": float(over.sharpness.min(initial=1.0)), "blurred": float(len(blurred))}
    if not blurred:
        return Finding(
            name="sharpness",
            verdict="ok",
            numbers=numbers,
            sentence="No frame is much less sharp than its neighbours "
            f"(the least sharp has {numbers['least_relative_sharpness']:.2f} of their sharpness).",
        )
    return Finding(
        name="sharpness",
        verdict="doubtful",
        numbers=numbers,
        repair=repair,
        sentence=f"More blurred than their neighbours: frame {_list(blurred)}.",
    )


def frozen_finding(over: OverFrames, frozen: abc.Mapping[int, str], repair: str, *, posed: bool = True) -> Finding:
    """Finding: are images repeated while the camera moves?

    Args:
        over: Measurements from frame to frame.
        frozen: Frames that repeat the one before, compared pixel by pixel, and what they repeat.
        repair: Options that leave them out.
        posed: Whether there are poses, which say that the camera moved.
    """
    numbers = {"frozen": float(len(frozen)), "repeated": float((over.same_colour | over.same_depth).sum())}
    if not frozen:
        text = "No image is repeated while the poses move." if posed else "No image repeats the one before."
        return Finding(name="frozen frames", verdict="ok", numbers=numbers, sentence=text)
    kinds = {kind: [n for n in frozen if frozen[n] == kind] for kind in ("both", "colour", "depth")}
    images = {"both": "colour and depth", "colour": "only colour", "depth": "only depth"}
    which = "; ".join(f"{images[kind]} of frame {_list(those)}" for kind, those in kinds.items() if those)
    moved = "although the pose changed" if posed else "(whether the camera moved cannot be known without poses)"
    return Finding(
        name="frozen frames",
        verdict="wrong" if posed else "doubtful",
        numbers=numbers,
        repair=repair,
        sentence=f"The image of the previous frame is repeated pixel by pixel {moved}: {which}.",
    )


def _list(frames: abc.Sequence[int]) -> str:
    named = ", ".join(map(str, frames[:_NAMED]))
    return f"{named} and {len(frames) - _NAMED} more" if len(frames) > _NAMED else named
