"""Score the map in a run's folder again, only from its files, exactly as the run did."""

import logging
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ..config import DataConfig, from_run
from ..data import OpenedSequence, open_sequence, sequence_fingerprint
from ..errors import ArgumentError, SequenceNotFoundError
from ..evaluation import metrics_as_json
from ..files import parsing, read_object
from ..mapping import Mapper
from .outputs import write_json
from .run_folder import METRICS
from .scored_views import read_views, score_in_map
from .stored_map import read_gaussians
from .system_of_run import system_of_run

log = logging.getLogger(__name__)


def rescore(
    folder: Path | str,
    *,
    data: str | None = None,
    system: str | type[Mapper] | None = None,
    with_lpips: bool = False,
    device: torch.device | str | None = None,
) -> dict[str, Any]:
    """Render the map of a finished run from the views in views.json, and update the scores in
    metrics.json.

    The system renders as in the run, from gaussians.ply (GPS-SLAM: and tsdf.npz), at the poses in
    views.json. On the same device and backend the scores are equal to the run's, bit for bit. If
    some differ, the log and the warnings in metrics.json list them. A warning also says if the data
    has other frames, poses or images than in the run.

    Args:
        folder: Folder of the run.
        data: Current folder of the sequence, if it has moved.
        system: Of a run whose system came from a file: "RUN/system.py:Name", or your own
            "FILE.py:Name" with the same content, which is executed; or its class.
        with_lpips: Also compute LPIPS.
        device: Where to render; by default the device of the run.

    Returns:
        All metrics of the run.

    Raises:
        SystemNotNamedError: The run's system came from a file, and ``system`` names none.
        FileNotFoundError: The folder has no config.json, metrics.json, views.json or gaussians.ply
            (or tsdf.npz).
        ValueError: One of them is damaged, or the sequence of the run is not on disk.
    """
    folder = Path(folder)
    settings = read_object(
        folder / "config.json", "the settings of a run", objects=("source", "config")
    )
    document = read_object(folder / METRICS, "the numbers of a run", objects=("metrics",))
    mapper_type = system_of_run(
        folder, settings, system, lambda own: f"rescore({str(folder)!r}, system={own!r})"
    )
    with parsing(folder / "config.json", "the settings of a run"):
        source = dict(settings["source"])
        config = from_run(mapper_type.config_type, settings["config"])
        stored_device = torch.device(settings["device"])
    if data is not None:
        source["path_or_name"] = data
    if "path_or_name" not in source:
        raise ArgumentError(
            f"{folder} was mapped from a sequence in memory; if the sequence is also on disk, give "
            "its folder (--data)"
        )
    views = read_views(folder)
    sequence = _sequence_of(folder, source, config.data)
    content = settings.get("data_content")
    if content and content != sequence_fingerprint(sequence):
        _warn(
            document,
            f"{source['path_or_name']} does not hold the data that this run was mapped from: the "
            "scores compare the map with other images",
        )
    place = torch.device(device or (stored_device if torch.cuda.is_available() else "cpu"))
    params = read_gaussians(folder, config.sh_degree, place)
    draw = mapper_type.files_type.drawn_from(folder, params, config)
    align = None
    if config.data.align_held_out:
        align = partial(mapper_type.files_type.aligned_pose, draw, params, config=config)
    scores = metrics_as_json(
        score_in_map(draw, views, sequence, with_lpips=with_lpips, align=align)
    )
    stored_metrics = document["metrics"]
    if not with_lpips:
        scores = {
            name: value
            for name, value in scores.items()
            if not (name.startswith("lpips") and name in stored_metrics)
        }
    if differences := _differences(stored_metrics, scores):
        _warn(document, f"these scores differ from those of the run: {differences}")
    document["metrics"] = stored_metrics | scores
    write_json(folder / METRICS, document)
    return document["metrics"]


def _differences(stored_metrics: dict[str, Any], scores: dict[str, Any]) -> str:
    """The scores that are other numbers now, "psnr_db 30.1 -> 30.2"; "" if none is."""
    return ", ".join(
        f"{name} {_short(stored_metrics[name])} -> {_short(value)}"
        for name, value in scores.items()
        if _is_number(stored_metrics.get(name)) and value != stored_metrics[name]
    )


def _sequence_of(folder: Path, source: dict[str, Any], data: DataConfig) -> OpenedSequence:
    """The sequence of the run in ``folder``."""
    file = folder / "config.json"
    try:
        with parsing(file, "the settings of a run"):
            return open_sequence(**source, data=data)
    except SequenceNotFoundError as e:
        raise SequenceNotFoundError(
            f"{e}; this path is from {file}: if the sequence has moved, give its folder with --data"
        ) from None


def _warn(document: dict[str, Any], sentence: str) -> None:
    """Log a warning, and write it, once, among those of metrics.json."""
    log.warning(sentence)
    document["warnings"] = list(dict.fromkeys([*document.get("warnings", ()), sentence]))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) or value == "infinite"


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
