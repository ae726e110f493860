"""The numbers of a run: names, units, digits, and their format in text."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

NBSP = "\u00a0"


@dataclass(frozen=True)
class NotComputed:
    """Used in place of a number. In JSON it is ``{"not_computed": reason}``."""

    reason: str
    """The reason, without a full stop."""

    def __str__(self) -> str:
        return f"not computed: {self.reason}"

    def as_json(self) -> dict[str, str]:
        """The form in metrics.json."""
        return {"not_computed": self.reason}


@dataclass(frozen=True)
class Metric:
    """Format of one number."""

    label: str
    unit: str = ""
    digits: int = 2
    scale: float = 1.0
    """Factor from the stored unit to the shown one."""
    meaning: str = ""
    """Explanation in one sentence."""


def _cm(label: str, meaning: str = "") -> Metric:
    return Metric(label, "cm", 2, 100.0, meaning)


def _count(label: str, meaning: str = "", unit: str = "") -> Metric:
    return Metric(label, unit, 0, 1.0, meaning)


def _share(label: str, meaning: str) -> Metric:
    return Metric(label, "%", 1, 100.0, meaning)


def _index(label: str, meaning: str) -> Metric:
    return Metric(label, "", 3, 1.0, meaning)


def _image_metrics(suffix: str) -> dict[str, Metric]:
    released = "as GSFusion's evaluation"
    psnr = "Mean of the per-image PSNR, 8-bit images. Higher is better."
    border = "Without a border of 5 pixels."
    bgr = "From BGR in 0..1."
    return {
        f"psnr_{suffix}_db": Metric("PSNR", "dB", 2, 1.0, psnr),
        f"ssim_{suffix}": _index(
            "SSIM", "Structural similarity, 11x11 Gaussian window. 1 is perfect."
        ),
        f"lpips_{suffix}": _index(
            "LPIPS", "Learned perceptual distance, AlexNet. Lower is better."
        ),
        f"ssim_as_released_{suffix}": _index(
            f"SSIM {released}", f"{border} Only for published tables."
        ),
        f"lpips_as_released_{suffix}": _index(
            f"LPIPS {released}", f"{bgr} Only for published tables."
        ),
        f"depth_l1_{suffix}_m": _cm(
            "Depth error", "Mean |rendered - measured depth| where both exist."
        ),
        f"n_views_{suffix}": _count("Views scored"),
        f"n_views_nan_{suffix}": _count(
            "Views with a NaN", "Their renders are not numbers; no mean counts them."
        ),
        f"n_views_no_depth_{suffix}": _count(
            "Views without a depth error", "The mean depth error is of the others."
        ),
    }


def _geometry_metrics(prefix: str, ours: str) -> dict[str, Metric]:
    return {
        f"{prefix}_accuracy_m": _cm("Accuracy", f"Mean distance from {ours} to the true surface."),
        f"{prefix}_completion_m": _cm(
            "Completion", f"Mean distance from the true surface to {ours}."
        ),
        f"{prefix}_precision": _share(
            "Precision", f"Share of {ours} within the threshold of the truth."
        ),
        f"{prefix}_completion_ratio": _share(
            "Completion ratio", "Share of the true surface within the threshold."
        ),
        f"{prefix}_f_score": _index("F-score", "Harmonic mean of precision and completion ratio."),
        f"{prefix}_threshold_m": Metric("Threshold", "cm", 1, 100.0),
    }


_AT_THE_END = "Of the map at the end of the sequence."
ONLINE = {
    "psnr_held_out_online_db": Metric("PSNR, held out", "dB", 2, 1.0, _AT_THE_END),
    "psnr_mapped_online_db": Metric("PSNR, mapped", "dB", 2, 1.0, _AT_THE_END),
    "ssim_held_out_online": _index("SSIM, held out", _AT_THE_END),
    "ssim_mapped_online": _index("SSIM, mapped", _AT_THE_END),
    "depth_l1_held_out_online_m": _cm("Depth error, held out", _AT_THE_END),
}
"""What is kept of the scores before the passes after the scan."""

_COLOURS = "Colours of the vertices and of the pixels that show them, mean of the views."
_TOTAL = "Mapped frames divided by the sum of their times, without compiling kernels."
_MEAN_INVERSE = "As in the GSFusion paper; never below frames / total time."
_WHOLE = "The sum of the stages below; in the report without the report itself."
_PEAK = "Largest resident memory of the process, or GPU memory."
_DRIFT = (
    "Between the last estimated and the last true camera centre; the first pose is given by "
    "the data."
)
_DEGENERATE = "A direction of motion could not be measured and was taken from the prediction."
METRIC_GROUPS: dict[str, dict[str, Metric]] = {
    "Novel views (held out)": _image_metrics("held_out"),
    "Novel views, each pose fitted to the map": _image_metrics("held_out_aligned"),
    "Novel views, pose and exposure fitted to the map": _image_metrics("held_out_fitted"),
    "Novel views, each with pose and exposure of the views before and after it": _image_metrics(
        "held_out_between"
    ),
    "Mapped views": _image_metrics("mapped"),
    "Before the global optimisation": ONLINE,
    "Maps": {
        "n_gaussians": _count("Gaussians"),
        "n_not_finite": _count(
            "Gaussians lost", "They became NaN or infinite in a gradient step and were removed."
        ),
        "model_size_mb": Metric(
            "Model size", "MB", 1, 1.0, "Size of gaussians.ply; 1 MB is a million bytes."
        ),
        "n_stable_opaque": _count("Stable opaque"),
        "n_stable_transparent": _count("Stable transparent"),
        "n_unstable_opaque": _count("Unstable opaque"),
        "n_unstable_transparent": _count("Unstable transparent"),
        "n_keyframes": _count("Keyframes"),
        "n_frames": _count("Frames mapped"),
        "n_blocks": _count("Voxel blocks"),
        "n_triangles": _count("Mesh triangles"),
        "mesh_share": _share(
            "Seen surface in the mesh", "The mesh is made from some of the views, which overlap."
        ),
        "loss": Metric("Loss, instead of the system's own"),
        "optimiser": Metric("Optimiser, instead of Adam"),
    },
    "States of the Gaussians, mean of the frames": {
        "share_stable": _share("Stable", "No longer optimised."),
        "share_stable_transparent": _share("Stable, transparent", "Share of all Gaussians."),
        "share_unstable": _share("Unstable", "Optimised in every window that sees them."),
        "share_unstable_transparent": _share("Unstable, transparent", "Share of all Gaussians."),
        "share_transparent": _share("Transparent", "They correct the colour of stable ones."),
        "share_stable_last": _share(
            "Stable after the last frame", "Before the passes, in which all become stable."
        ),
    },
    "Speed and memory": {
        "fps_total": Metric("Speed, frames / total time", "frames/s", 2, 1.0, _TOTAL),
        "fps_mean_inverse": Metric("Speed, mean of 1/dt", "frames/s", 2, 1.0, _MEAN_INVERSE),
        "fps_mapping": Metric(
            "Speed, mapping alone", "frames/s", 2, 1.0, "Without the time of tracking."
        ),
        "fps_tracking": Metric("Speed, tracking alone", "frames/s", 2),
        "seconds_online": Metric("Online mapping", "s", 1),
        "seconds_global": Metric("Global optimisation", "s", 1),
        "peak_memory_mb": _count("Peak memory", _PEAK, "MB"),
    },
    "Time of the whole run": {
        "seconds_total": Metric("Whole run", "s", 1, 1.0, _WHOLE),
        "seconds_opening": Metric("Opening the data", "s", 1),
        "seconds_compiling": Metric(
            "Compiling kernels", "s", 1, 1.0, "Once on a machine; in no other time or speed."
        ),
        "seconds_reading": Metric(
            "Reading frames", "s", 1, 1.0, "Waiting for them, if they are read in advance."
        ),
        "seconds_mapping": Metric("Mapping", "s", 1),
        "seconds_passes": Metric("Passes after the scan", "s", 1),
        "seconds_mesh": Metric("Making the mesh", "s", 1),
        "seconds_writing": Metric("Writing maps", "s", 1),
        "seconds_checkpoints": Metric("Checkpoints", "s", 1),
        "seconds_view_scores": Metric("Scores of views", "s", 1),
        "seconds_mesh_scores": Metric("Scores of the mesh", "s", 1),
        "seconds_report": Metric("Report", "s", 1),
        "seconds_other": Metric("Everything else", "s", 1),
    },
    "Stream": {
        "n_frames_received": _count("Frames received"),
        "n_frames_dropped": _count(
            "Frames dropped", "They arrived while mapping was still busy with earlier frames."
        ),
        "n_frames_unusable": _count("Frames unusable"),
    },
    "Taken out of the map of the earlier run": {
        "n_voxels_moved": _count("Voxels", "Frames of this run saw through them."),
        "n_gaussians_moved": _count("Gaussians"),
        "n_keyframes_moved": _count("Keyframes", "They show what is not there any more."),
    },
    "Location in the map": {
        "share_located": _share("Frames located", "The others are not in the trajectory."),
        "n_frames_to_locate": _count("Frames"),
        "n_located": _count("Of these, located"),
        "share_within_3_cm": _share(
            "Located within 3 cm", "Share of all frames, also of those that were not located."
        ),
        "location_error_median_m": _cm("Error, median", "Of located frames, against their poses."),
        "location_error_mean_m": _cm("Error, mean"),
        "location_error_max_m": _cm("Error, largest"),
        "location_error_median_deg": Metric("Rotation error, median", "°", 2),
        "location_error_max_deg": Metric("Rotation error, largest", "°", 2),
        "seconds_per_located_frame": Metric(
            "Time of a frame", "s", 3, 1.0, "Median, without reading it."
        ),
        "seconds_opening_map": Metric("Opening the map", "s", 1),
    },
    "Mesh against held-out views": {
        "mesh_psnr_held_out_db": Metric("PSNR", "dB", 2, 1.0, _COLOURS)
    },
    "Mesh against ground truth": _geometry_metrics("mesh", "our mesh"),
    "Gaussian centres against the run's own mesh, as GSFusion's evaluation": {
        "centres_to_own_mesh_m": _cm(
            "Mean distance", "To samples of our own mesh: agreement of the maps, not accuracy."
        ),
        "centres_to_own_mesh_m2": Metric("Mean squared distance", "cm²", 2, 1e4),
    },
    "Discs against ground truth": _geometry_metrics("disc", "the opaque discs, to one sigma,"),
    "Trajectory": {
        "ate_rmse_m": _cm(
            "ATE RMSE", "Root mean square distance of camera centres after alignment."
        ),
        "ate_mean_m": _cm("ATE mean", "Mean distance of camera centres after alignment."),
        "drift_m": _cm("Drift at the end", _DRIFT),
        "rpe_translation_m": _cm("RPE, translation", "Root mean square, frame to frame."),
        "n_recovered": _count("Tracking recovered", unit="frames"),
        "n_degenerate": _count("Degenerate motion", _DEGENERATE, "frames"),
        "rpe_rotation_deg": Metric(
            "RPE, rotation", "°", 3, 1.0, "Root mean square, frame to frame."
        ),
    },
}
"""Group heading -> name in metrics.json -> format."""

METRICS: dict[str, Metric] = {
    name: metric for group in METRIC_GROUPS.values() for name, metric in group.items()
}


def reason_missing(value: Any) -> str | None:
    """The reason why ``value`` is not a number, or None if it is one. Also accepts values read from
    metrics.json."""
    if value is None:
        return "not measured in this run"
    if isinstance(value, NotComputed):
        return value.reason
    if isinstance(value, Mapping) and "not_computed" in value:
        return str(value["not_computed"])
    if isinstance(value, float) and math.isnan(value):
        return "the result is not a number"
    return None


def format_metric(name: str, value: Any) -> str:
    """A number with its unit and rounded digits, or "not computed: reason". Unknown names get four
    digits."""
    reason = reason_missing(value)
    if reason is not None:
        return f"not computed: {reason}"
    metric = METRICS.get(name)
    if metric is None or isinstance(value, (str, bool)):
        return format_value(value)
    number = float(value) * metric.scale
    unit = metric.unit
    text = "∞" if math.isinf(number) else f"{number:,.{metric.digits}f}"
    return f"{text}{NBSP}{unit}" if unit and unit not in "°" else f"{text}{unit}"


def format_value(value: Any) -> str:
    """A setting or an unnamed number as short text."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(format_value(v) for v in value)
    return str(value)


def metrics_as_json(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """The same numbers for strict JSON, which has no NaN: missing ones become
    ``{"not_computed": reason}``."""

    def plain(value):
        reason = reason_missing(value)
        if reason is not None:
            return NotComputed(reason).as_json()
        return "infinite" if isinstance(value, float) and math.isinf(value) else value

    return {name: plain(value) for name, value in metrics.items()}


def frame_rates(seconds: Sequence[float | int]) -> dict[str, float | NotComputed]:
    """Both definitions of frames per second, from the time of each frame.

    ``fps_total`` = n / sum dt.  ``fps_mean_inverse`` = mean of 1 / dt, as in the GSFusion paper; it
    is never smaller than ``fps_total``, and a few very fast frames increase it strongly.
    """
    if not seconds or min(seconds) <= 0:
        missing = NotComputed("no frame was timed" if not seconds else "a frame took no time")
        return {"fps_total": missing, "fps_mean_inverse": missing}
    return {
        "fps_total": len(seconds) / sum(seconds),
        "fps_mean_inverse": sum(1.0 / s for s in seconds) / len(seconds),
    }
