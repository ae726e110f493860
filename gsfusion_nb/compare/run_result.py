"""What came out of one run, as plain values."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ..checks import shown
from ..errors import ArgumentError
from ..files import read_sealed, write_sealed
from .spec import RunSpec

MEASURED = frozenset(
    {
        "ms_per_frame",
        "cpu_ms_per_frame",
        "seeding_ms",
        "seconds_total",
        "seconds_global",
        "peak_memory_mb",
    }
)
"""Metrics that differ from one run to the next; all others are equal bit for bit for equal keys."""


@dataclass(frozen=True, kw_only=True)
class RunResult:
    """What one run gave. A run that failed has a ``reason`` and no metrics."""

    spec: RunSpec
    """The run."""
    status: Literal["done", "failed"]
    reason: str = ""
    """Why it failed, in a sentence."""
    metrics: Mapping[str, float] = field(default_factory=dict)
    """Numbers by their names in metrics.json; a number that could not be computed is absent.
    psnr_mapped_db, psnr_held_out_db, ssim_mapped, ssim_held_out, lpips_mapped, lpips_held_out,
    depth_l1_mapped_m, depth_l1_held_out_m, mesh_accuracy_m, mesh_completion_m, disc_accuracy_m,
    disc_completion_m (and their ratios), mesh_psnr_held_out_db, n_gaussians, n_keyframes, n_steps
    (gradient steps), n_frames, ms_per_frame and cpu_ms_per_frame (of mapping, mean over all frames
    but the first), seeding_ms (of that the rule), seconds_total (mapping with all its optimisation,
    without scoring), seconds_global (of that after the scan), model_size_mb, peak_memory_mb (growth
    while mapping)."""
    tuned: Mapping[str, Any] = field(default_factory=dict)
    """How the budget was reached: option, value, n_runs (tuning runs), error_percent. Empty without
    a budget."""
    notes: list[str] = field(default_factory=list)
    """What differs from the other runs of a comparison, as sentences."""
    map_hash: str = ""
    """SHA-256 of the maps: equal for maps that are equal bit for bit."""
    data_hash: str = ""
    """Hash of the frames, poses and camera."""
    frames: Sequence[str] = field(default_factory=list)
    """``frame_fingerprints`` of the data: scenes with one in common are not independent."""
    rule_source: str = ""
    """Source code of the rule."""
    training: str = ""
    """How the publication of the rule trains the Gaussians, if not as in this run
    (``trained_otherwise``)."""
    image_size: str = ""
    """Width and height of the frames that were mapped, pixels: "640x480"."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Versions of the programs, and the machine."""
    copied_from: str = ""
    """Folder of the store that had this result of an earlier command; empty for one that was
    computed now."""
    pictures: Mapping[str, str] = field(default_factory=dict)
    """Name of a picture -> its file, relative to the output folder: "held_out 4" is the render of
    frame 4, which was held out, "truth 4" its recorded image."""

    @property
    def key(self) -> str:
        """Content key of the run."""
        return self.spec.key

    def to_json(self) -> dict[str, Any]:
        """The result as plain values; numbers that are not finite are left out."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)} | {
            "spec": self.spec.to_json()
        }
        values["metrics"] = {name: v for name, v in self.metrics.items() if math.isfinite(v)}
        values["key"] = self.key
        return values

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "RunResult":
        """The result that ``to_json`` gave.

        Raises:
            ValueError, TypeError, KeyError: ``values`` are not those of a result.
        """
        values = {name: value for name, value in values.items() if name != "key"}
        return cls(**{**values, "spec": RunSpec.from_json(values["spec"])})

    def save(self, path: Path) -> None:
        """Write the result to a JSON file with a checksum, completely or not at all."""
        write_sealed(path, self.to_json())

    @classmethod
    def load(cls, path: Path, *, key: str = "") -> "RunResult":
        """Read what ``save`` wrote.

        Args:
            path: The file.
            key: Of the run that it must be the result of; empty: any.

        Raises:
            ValueError: the file is damaged, was changed, or is from another version or of another
                run.
            FileNotFoundError: no such file.
        """
        document = read_sealed(path, "the result of a run of the lab")
        if key and document.get("key") != key:
            raise ArgumentError(
                f"{path} is the result of another run, with the key {shown(document.get('key'))}"
            )
        try:
            return cls.from_json(document)
        except (TypeError, KeyError, AttributeError) as e:
            raise ArgumentError(f"{path} is not the result of a run of the lab: {e}") from None
