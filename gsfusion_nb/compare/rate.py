"""Picture of the study "rate": held-out PSNR over the time per frame, one point a variant."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .pareto import ParetoPoints, pareto_figure

_RATE, _QUALITY = "fps_total", "psnr_held_out_db"


def draw_rates(results: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Draw the variants that have a rate and a PSNR, with the front of those that no other beats.

    Args:
        results: Label -> metrics of its run, or ``{"error": message}``.
        path: The picture to write.
    """
    shown = {label: m for label, m in results.items() if isinstance(m.get(_RATE), float) and _QUALITY in m}
    points = ParetoPoints(
        names=list(shown),
        cost=np.array([1e3 / m[_RATE] for m in shown.values()]),
        quality=np.array([m[_QUALITY] for m in shown.values()]),
        title="held-out views after the last frame",
        cost_label="ms per frame by the clock",
        quality_label="PSNR, dB",
    )
    pareto_figure(points).savefig(path)
