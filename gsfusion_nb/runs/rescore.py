"""Score the maps in a run's folder again, from its files alone."""

import json
from pathlib import Path
from typing import Any

from torch import Tensor

from ..config import from_dict
from ..data import open_sequence
from ..evaluation import metrics_as_json, score_views
from ..export import read_gaussian_ply
from ..mapping.systems import get_system
from ..types import Camera, RenderOutput
from .outputs import write_json
from .posed_frames import readable_frames


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
        ValueError: one of them is damaged, or the run was made from a sequence that is not on disk.
    """
    folder = Path(folder)
    settings = _read_json(folder / "config.json", ("source", "config"))
    document = _read_json(folder / "metrics.json", ("metrics", "frames"))
    source = settings["source"]
    if data is not None:
        source = {**source, "path_or_name": data}
    if "path_or_name" not in source:
        raise ValueError(f"{folder} was mapped from a sequence in memory; give the folder of one on disk (--data)")
    system = get_system(settings.get("system", "gsfusion"))
    config = from_dict(system.config_type, settings["config"])
    sequence = open_sequence(**source, data=config.data)
    params = read_gaussian_ply(folder / "gaussians.ply")

    def see(camera: Camera, T_WC: Tensor) -> RenderOutput:
        return system.render_gaussians(params, camera, T_WC, config)

    indices = {row["frame_index"] for row in document["frames"]}
    for name, view in (("held_out", readable_frames(sequence.held_out)), ("mapped", readable_frames(sequence.mapping))):
        frames = (frame for frame in view if name == "held_out" or frame.index in indices)
        scores = score_views(see, frames, with_lpips=with_lpips)
        document["metrics"] |= metrics_as_json(scores.as_metrics(name) | {f"n_views_{name}": len(scores)})
    write_json(folder / "metrics.json", document)
    return document["metrics"]


def _read_json(path: Path, keys: tuple[str, ...]) -> dict[str, Any]:
    """The document in ``path``, which must have ``keys``."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} is not there; expected the folder of a finished run")
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as e:
        raise ValueError(f"{path} is not valid JSON: {e}") from None
    lacking = [key for key in keys if not isinstance(document, dict) or key not in document]
    if lacking:
        raise ValueError(f"{path} is not of a run: expected the keys {', '.join(keys)}, lacking {', '.join(lacking)}")
    return document
