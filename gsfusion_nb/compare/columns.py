"""The columns of the lab's tables: which numbers of a run are shown, in which unit, and which direction is better."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from ..evaluation.metrics import METRICS

Better = Literal["higher", "lower", "neither"]
Views = Literal["held out", "between neighbours", "mapped", ""]


@dataclass(frozen=True, kw_only=True)
class Column:
    """One number of a run, as the tables show it."""

    metric: str
    """Name in ``RunResult.metrics``."""
    heading: str
    views: Views = ""
    """The views that it is the mean of; empty if it belongs to the whole run."""
    unit: str = ""
    digits: int = 2
    scale: float = 1.0
    """Factor from the stored unit to the shown one."""
    better: Better = "neither"
    group: Literal["quality", "cost"] = "quality"
    """Wide tables are split into these two."""

    @property
    def name(self) -> str:
        """Heading, views and unit in one text: "PSNR held out, dB"."""
        words = f"{self.heading} {self.views}".strip()
        return f"{words}, {self.unit}" if self.unit else words

    def shown(self, value: float) -> float:
        """A value in the unit of the table, rounded to the digits that are shown."""
        return round(value * self.scale, self.digits)

    def text(self, value: float) -> str:
        """A value as text, without its unit; "–" for NaN."""
        number = self.shown(value)
        if number != number:
            return "–"
        return "∞" if number == float("inf") else f"{number:,.{self.digits}f}"


def _image_columns(metric: str, heading: str, better: Better) -> Iterable[Column]:
    groups: tuple[tuple[str, Views], ...] = (
        ("held_out", "held out"), ("held_out_between", "between neighbours"), ("mapped", "mapped"),
    )  # fmt: skip
    for views, word in groups:
        name = metric.format(views)
        known = METRICS[name]
        yield Column(
            metric=name, heading=heading, views=word, unit=known.unit, digits=known.digits, scale=known.scale,
            better=better,
        )  # fmt: skip


def _cost(metric: str, heading: str, unit: str = "", digits: int = 0, better: Better = "lower") -> Column:
    return Column(metric=metric, heading=heading, unit=unit, digits=digits, better=better, group="cost")


_ALL = (
    *_image_columns("psnr_{}_db", "PSNR", "higher"),
    *_image_columns("ssim_{}", "SSIM", "higher"),
    *_image_columns("lpips_{}", "LPIPS", "lower"),
    *_image_columns("depth_l1_{}_m", "Depth error", "lower"),
    Column(metric="mesh_accuracy_m", heading="Mesh accuracy", unit="cm", scale=100.0, better="lower"),
    Column(metric="mesh_completion_m", heading="Mesh completion", unit="cm", scale=100.0, better="lower"),
    Column(metric="ate_rmse_m", heading="ATE RMSE", unit="cm", scale=100.0, better="lower"),
    _cost("n_gaussians", "Gaussians"),
    _cost("n_keyframes", "Keyframes", better="neither"),
    _cost("n_steps", "Gradient steps", better="neither"),
    _cost("ms_per_frame", "Time per frame", "ms", 1),
    _cost("cpu_ms_per_frame", "CPU time per frame", "ms", 1),
    _cost("seeding_ms", "Seeding per frame", "ms", 1),
    _cost("seconds_total", "Whole run", "s", 1),
    _cost("peak_memory_mb", "Memory", "MB"),
)
COLUMNS: Mapping[str, Column] = {column.metric: column for column in _ALL}
"""Name of a number -> its column, in the order of the tables."""

FIRST_METRIC = "psnr_held_out_db"
"""The number that rules are ranked and compared by, unless another one is asked for."""
