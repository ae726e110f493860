"""What a command prints of a run."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..runs import FinishedRun


def print_result(run: "FinishedRun") -> int:
    """Print a run's numbers, notes and files.

    Returns:
        The exit status: 0; 130 if the run was interrupted; 3 if it ended before the recording,
        because tracking was lost and not found again, or too many frames in a row could not be
        used.
    """
    print_metrics(run.metrics)
    for warning in run.run.warnings:
        print(f"note: {warning}")
    print(f"Files in {run.folder}:")
    for path in sorted(path for path in run.folder.iterdir() if path.name[0] != "."):
        print(f"  {path.name:<16} {path.stat().st_size / 1e6:8.2f} MB")
    is_interrupted = run.run.status == "interrupted"
    lost_frames = run.run.mapper.localiser.frames_lost
    if lost_frames and not is_interrupted:
        print(
            "Tracking was lost and not found again: the last "
            f"{lost_frames} frames are not in the map."
        )
    if is_interrupted and run.run.resumable:
        from ..runs.resume import resume_command

        print(f"To continue: {resume_command(run.folder, run.mapper)}")
    return 130 if is_interrupted else 3 if lost_frames or run.run.status == "stopped" else 0


def print_metrics(metrics: dict[str, Any]) -> None:
    """Print the known metrics, in groups."""
    from ..evaluation.metrics import METRIC_GROUPS, format_metric

    for group, metrics_of_group in METRIC_GROUPS.items():
        rows = [
            (metric.label, format_metric(name, metrics[name]))
            for name, metric in metrics_of_group.items()
            if name in metrics
        ]
        if rows:
            print(group)
        for label, value in rows:
            print(f"  {label:<28} {value}")
