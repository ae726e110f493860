"""The frames of a walk by what is done with them: mapped, held out between mapped ones, or in a
stretch that is not mapped."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..data import OpenedSequence
from ..errors import ArgumentError
from ..geometry import se3
from ..runs.mapped_views import evenly
from ..types import Frame

GAPS = ((0.30, 0.40), (0.65, 0.75))
"""Stretches of the walk that are not mapped, as shares of its frames."""
LEAST_FRAMES = 20
MOST_MAPPED_VIEWS = 32
"""Mapped views that are scored, evenly spread."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WalkSplit:
    """A walk of which two stretches are left out, and views of it to score a map with."""

    sequence: OpenedSequence
    """What is mapped, and what is held out between."""
    far: list[int]
    """Positions of the frames in the gaps, and of those that the data set publishes as test
    views."""

    @staticmethod
    def of(sequence: OpenedSequence) -> "WalkSplit":
        """Take the frames of ``GAPS`` out of what is mapped and held out.

        Raises:
            ValueError: fewer than ``LEAST_FRAMES`` frames, or none held out between mapped ones.
        """
        novel = set(getattr(sequence.source, "novel", ()))
        walk = sorted({*sequence.mapping.positions, *sequence.held_out.positions} - novel)
        if len(walk) < LEAST_FRAMES:
            raise ArgumentError(
                f"expected at least {LEAST_FRAMES} frames, because two stretches of the walk are "
                f"left out; {sequence.name} has {len(walk)}"
            )
        gaps = {
            position
            for first, last in GAPS
            for position in walk[round(first * len(walk)) : round(last * len(walk))]
        }
        mapped, held_out = (
            [p for p in view.positions if p not in gaps | novel]
            for view in (sequence.mapping, sequence.held_out)
        )
        if not held_out:
            raise ArgumentError(
                "no view is held out between mapped ones: set data.hold_out_every to 2 or more"
            )
        return WalkSplit(
            sequence=dataclasses.replace(
                sequence,
                mapping=dataclasses.replace(sequence.mapping, positions=mapped),
                held_out=dataclasses.replace(sequence.held_out, positions=held_out),
            ),
            far=sorted(gaps | (novel & set(sequence.held_out.positions))),
        )

    def views(self) -> dict[str, list[int]]:
        """Name of each group of scored views -> positions of its frames."""
        mapped = self.sequence.mapping.positions
        return {
            "mapped": [mapped[i] for i in evenly(len(mapped), MOST_MAPPED_VIEWS)],
            "between": list(self.sequence.held_out.positions),
            "far": self.far,
        }

    def frames(self, positions: Sequence[int]) -> Iterator[Frame]:
        """The frames at some positions, as they are mapped."""
        yield from dataclasses.replace(self.sequence.mapping, positions=list(positions))

    def distance(self, positions: Sequence[int]) -> tuple[float, float]:
        """How far views are from the nearest mapped one (``pose_distance``), on average: degrees,
        and metres."""
        source = self.sequence.source
        mapped_poses = [source.pose(p) for p in self.sequence.mapping.positions]
        motions = []
        for position in positions:
            T_WC = source.pose(position)
            nearest = min(mapped_poses, key=lambda T, T_WC=T_WC: pose_distance(T, T_WC))
            motions.append(se3.motion(nearest, T_WC))
        degrees, metres = torch.tensor(motions, dtype=torch.float64).mean(0).tolist()
        return degrees, metres


def pose_distance(T_a: Float[Tensor, "4 4"], T_b: Float[Tensor, "4 4"]) -> float:
    """Metres between two cameras plus radians between their axes: turning by one radian counts as a
    metre, about the distance of what a camera sees in a room."""
    turned_deg, moved_m = se3.motion(T_a, T_b)
    return moved_m + math.radians(turned_deg)
