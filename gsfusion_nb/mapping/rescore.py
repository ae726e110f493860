"""Score the maps in a run's folder again, from its files alone."""

import json
from pathlib import Path
from typing import Any

from ..config import GSFusionConfig, from_dict
from ..datasets import open_sequence
from ..evaluation import metrics_as_json, score_views
from ..export import read_gaussian_ply
from ..render import render
from .outputs import write_json


def rescore(folder: Path | str, *, data: str | None = None, with_lpips: bool = False) -> dict[str, Any]:
    """Render gaussians.ply of a finished run from every mapped and held-out view, and update metrics.json.

    Args:
        folder: Folder of the run.
        data: Where the sequence lies now, if it has moved.
        with_lpips: Also compute LPIPS.

    Returns:
        All numbers of the run.

    Raises:
        FileNotFoundError: the folder holds no config.json or no gaussians.ply.
        ValueError: the run was made from a sequence that is not on disk, so it cannot be opened again.
    """
    folder = Path(folder)
    settings = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    source = settings["source"]
    if data is not None:
        source = {**source, "path_or_name": data}
    if "path_or_name" not in source:
        raise ValueError(f"{folder} was mapped from a sequence in memory; give the folder of one on disk (--data)")
    config = from_dict(GSFusionConfig, settings["config"])
    sequence = open_sequence(**source, data=config.data)
    params = read_gaussian_ply(folder / "gaussians.ply")

    document = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    for name, view in (("held_out", sequence.held_out), ("mapped", sequence.mapping)):
        scores = score_views(lambda camera, T_WC: render(params, camera, T_WC), view, with_lpips=with_lpips)
        document["metrics"] |= metrics_as_json(scores.as_metrics(name) | {f"n_views_{name}": len(scores)})
    write_json(folder / "metrics.json", document)
    return document["metrics"]
