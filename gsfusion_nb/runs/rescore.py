"""Score the maps in a run's folder again, from its files alone, exactly as the run did."""

import dataclasses
import logging
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .. import __version__
from ..config import from_dict
from ..data import open_sequence, sequence_fingerprint
from ..errors import SequenceNotFoundError
from ..evaluation import metrics_as_json
from ..export import read_gaussian_ply
from ..foreign import parsing
from ..mapping.systems import get_system
from ..strict_json import read_json
from ..types import Camera, GaussianParams, RenderOutput
from .outputs import write_json
from .scored_views import read_views, score_in_map

log = logging.getLogger(__name__)

METRICS = "metrics.json"


def rescore(
    folder: Path | str,
    *,
    data: str | None = None,
    with_lpips: bool = False,
    device: torch.device | str | None = None,
) -> dict[str, Any]:
    """Render gaussians.ply of a finished run from the views that the run is scored by, and update metrics.json.

    The views and their poses in the map are those in views.json; the system renders as in the run. On the same device
    and backend the numbers are the run's own, bit for bit. If they are not, the log and the warnings in metrics.json
    say which, and the file as it was stays beside the new one as metrics-before-eval.json. Data with other frames,
    poses or pixels than those of the run are named there too.

    Args:
        folder: Folder of the run.
        data: Where the sequence lies now, if it has moved.
        with_lpips: Also compute LPIPS.
        device: Where to render; the run's by default.

    Returns:
        All numbers of the run.

    Raises:
        FileNotFoundError: the folder holds no config.json, metrics.json, views.json or gaussians.ply.
        ValueError: one of them is damaged, or the run was made from a sequence that is not on disk.
    """
    folder = Path(folder)
    settings = _read_json(folder / "config.json", ("source", "config"))
    document = _read_json(folder / METRICS, ("metrics", "frames"))
    with parsing(folder / "config.json", "the settings of a run"):
        source = dict(settings["source"])
        system = get_system(settings.get("system", "gsfusion"))
        config = from_dict(system.config_type, settings["config"])
    if data is not None:
        source["path_or_name"] = data
    if "path_or_name" not in source:
        raise ValueError(f"{folder} was mapped from a sequence in memory; give the folder of one on disk (--data)")
    views = read_views(folder)
    try:
        with parsing(folder / "config.json", "the settings of a run"):
            sequence = open_sequence(**source, data=config.data)
    except SequenceNotFoundError as e:
        raise SequenceNotFoundError(
            f"{e}; {folder / 'config.json'} names this place: give another with --data if the sequence has moved"
        ) from None
    known = settings.get("data_fingerprint")
    if known and known != sequence_fingerprint(sequence):
        sentence = (
            f"{source['path_or_name']} does not hold the data that this run was mapped from (or another version of a "
            "library decodes them otherwise): the numbers compare the map with other views"
        )
        if sentence not in document.get("warnings", []):
            document["warnings"] = [*document.get("warnings", []), sentence]
        log.warning(sentence)
    place = torch.device(device or settings.get("device", "cpu"))
    params = _of_degree(read_gaussian_ply(folder / "gaussians.ply"), config.sh_degree, place)

    def see(camera: Camera, T_WC: Tensor) -> RenderOutput:
        return system.render_gaussians(params, camera, T_WC.to(place), config)

    scores = metrics_as_json(score_in_map(see, views, sequence, with_lpips=with_lpips))
    stored = document["metrics"]
    if not with_lpips:
        scores = {name: value for name, value in scores.items() if not (name.startswith("lpips") and name in stored)}
    changed = [name for name, value in scores.items() if _is_number(stored.get(name)) and value != stored[name]]
    if changed:
        kept = _free_name(folder)
        write_json(kept, document)
        sentence = _difference(changed, stored, scores, settings.get("gsfusion_nb", ""), kept)
        document["warnings"] = [*document.get("warnings", []), sentence]
        log.warning(sentence)
    document["metrics"] = stored | scores
    write_json(folder / METRICS, document)
    return document["metrics"]


def _of_degree(params: GaussianParams, degree: int, device: torch.device) -> GaussianParams:
    """The Gaussians with as many colour coefficients as in the run: the file fills them up to degree 3."""
    params = dataclasses.replace(params, sh=params.sh[:, : (degree + 1) ** 2].contiguous())
    return GaussianParams(**{name: column.to(device) for name, column in vars(params).items()})


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) or value == "infinite"


def _difference(changed: list[str], stored: dict, scores: dict, version: str, kept: Path) -> str:
    """What differs from the numbers of the run, and where these are kept."""
    shown = ", ".join(f"{name} {_short(stored[name])} -> {_short(scores[name])}" for name in changed)
    by = f" (mapped by version {version}, scored by {__version__})" if version and version != __version__ else ""
    return f"scored again, {len(changed)} numbers differ from the run's own{by}: {shown}; the run's are in {kept.name}"


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _free_name(folder: Path) -> Path:
    """A new file beside metrics.json."""
    n = 1
    while (path := folder / f"metrics-before-eval{'' if n == 1 else f'-{n}'}.json").exists():
        n += 1
    return path


def _read_json(path: Path, keys: tuple[str, ...]) -> dict[str, Any]:
    """The document in ``path``, which must have ``keys``."""
    document = read_json(path, "a file in the folder of a finished run")
    lacking = [key for key in keys if not isinstance(document, dict) or key not in document]
    if lacking:
        raise ValueError(f"{path} is not of a run: expected the keys {', '.join(keys)}, lacking {', '.join(lacking)}")
    return document
