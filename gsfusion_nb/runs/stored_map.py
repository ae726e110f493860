"""The map of a finished run, opened from its folder without a mapper; no code of the run is
executed, but that of its system if the caller names its file."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ..config import from_run
from ..errors import SequenceNotFoundError
from ..export import read_gaussian_ply
from ..files import parsing, read_object
from ..mapping import Mapper
from ..mapping.map_files import Draw
from ..tracking import PLACES, Places, SurfaceSource, read_places
from ..types import GaussianParams
from .system_of_run import system_of_run

CONFIG = "config.json"


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredMap:
    """What is needed to find a camera in the map of a run, and to draw it."""

    folder: Path
    system: str
    config: Any
    """Settings of the run."""
    document: dict[str, Any]
    """All of its config.json."""
    surface: SurfaceSource
    """The surface that frames are aligned with."""
    draw: Draw
    """The picture of the map."""
    places: Places
    """Its keyframes."""

    @property
    def source(self) -> dict[str, Any]:
        """How the recording of the run was opened."""
        source = self.document.get("source")
        return dict(source) if isinstance(source, dict) else {}


def open_map(
    folder: Path | str,
    device: torch.device | str = "cpu",
    system: str | type[Mapper] | None = None,
) -> StoredMap:
    """The map in the folder of a finished or interrupted run; ``system`` as for
    ``system_of_run``.

    Raises:
        SystemNotNamedError: the run's system came from a file, and ``system`` names none.
        FileNotFoundError: no such run, or one of a version that did not keep what finds a camera.
        ValueError: a file is damaged.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise SequenceNotFoundError(f"{folder} does not exist; expected the folder of a run")
    path = folder / CONFIG
    document = read_object(path, "the settings of a run", objects=("source", "config"))
    mapper = system_of_run(
        folder, document, system, lambda own: f"locate({str(folder)!r}, ..., system={own!r})"
    )
    with parsing(path, "the settings of a run"):
        config = from_run(mapper.config_type, document["config"])
    if not (folder / PLACES).exists():
        raise SequenceNotFoundError(
            f"{folder / PLACES} does not exist, by which a camera is found in the map; the run is "
            "from an older version, or it mapped no frame: map its recording again"
        )
    params = read_gaussians(folder, config.sh_degree, device)
    return StoredMap(
        folder=folder,
        system=str(document.get("system", "gsfusion")),
        config=config,
        document=document,
        surface=mapper.files_type.surface_from(folder, params, config),
        draw=mapper.files_type.drawn_from(folder, params, config),
        places=read_places(folder / PLACES),
    )


def read_gaussians(folder: Path, degree: int, device: torch.device | str) -> GaussianParams:
    """The Gaussians of the run in ``folder``, with its SH degree (the file is padded to degree 3),
    on ``device``.

    Raises:
        FileNotFoundError: there are none. ValueError: the file is damaged.
    """
    params = read_gaussian_ply(folder / "gaussians.ply", strict=True)
    params = dataclasses.replace(params, sh=params.sh[:, : (degree + 1) ** 2].contiguous())
    return GaussianParams(**{name: column.to(device) for name, column in vars(params).items()})
