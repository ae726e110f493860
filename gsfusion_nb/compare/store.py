"""Results on disk, one file for each content key, so that no run is computed twice."""

import contextlib
import dataclasses
import json
import logging
from pathlib import Path
from typing import Any

from ..files import cache_folder, write_file
from ..foreign import read_object
from .result import RunResult
from .run_key import run_key
from .spec import RunSpec
from .tune import tuning_spec

log = logging.getLogger(__name__)

RESULTS = "results"
"""Folder of the results in an output folder."""


class ResultStore:
    """The results in an output folder, and those of earlier commands in a shared cache.

    Args:
        folder: The output folder; results are in ``results/<key>.json``, pictures in ``pictures``. It is created.
        cache: Folder of the shared cache; ``lab`` in the cache folder of this package by default.
        shared: False uses no cache: nothing is copied from it or to it.
    """

    def __init__(self, folder: str | Path, cache: str | Path | None = None, *, shared: bool = True):
        self.folder = Path(folder).expanduser()
        self.cache = Path(cache).expanduser() if cache is not None else cache_folder() / "lab"
        self._places = (self.folder, self.cache) if shared else (self.folder,)
        (self.folder / RESULTS).mkdir(parents=True, exist_ok=True)

    def find(self, spec: RunSpec) -> RunResult | None:
        """The result of a run with the key of ``spec`` that is done, with the labels of ``spec``; None if none is.

        A result from the shared cache is copied to the output folder with its pictures, and says so.
        """
        for place in self._places:
            path = place / RESULTS / f"{spec.key}.json"
            try:
                found = RunResult.load(path) if path.is_file() else None
                if found is not None and found.status == "done":
                    found = dataclasses.replace(found, spec=spec)
                    if place == self.cache != self.folder:
                        found = dataclasses.replace(found, copied_from=str(self.cache))
                        self._copy(found, self.cache, self.folder)
                    return found
            except (ValueError, OSError) as e:  # damaged, from another version, or without its pictures
                log.warning("%s is not used: %s", path, e)
        return None

    def keep(self, result: RunResult) -> None:
        """Write a result to the output folder; one that is done also to the shared cache."""
        result.save(self.folder / RESULTS / f"{result.key}.json")
        if result.status == "done" and self.cache in self._places:
            with contextlib.suppress(OSError):  # a cache that cannot be written only costs time
                self._copy(result, self.folder, self.cache)

    def find_tuned(self, spec: RunSpec) -> dict[str, Any] | None:
        """What ``tune`` found for ``tuning_spec(spec)``; None if that is not known."""
        for place in self._places:
            path = place / "tuned" / f"{tuning_key(spec)}.json"
            if path.is_file():
                with contextlib.suppress(ValueError):
                    return read_object(path, "the tuned option of a rule")
        return None

    def keep_tuned(self, spec: RunSpec, tuned: dict[str, Any]) -> None:
        """Write what ``tune`` found for ``tuning_spec(spec)``."""
        for place in self._places:
            with contextlib.suppress(OSError):
                write_file(place / "tuned" / f"{tuning_key(spec)}.json", json.dumps(tuned, indent=1))

    def _copy(self, result: RunResult, start: Path, end: Path) -> None:
        for name in result.pictures.values():
            if not (end / name).exists():
                write_file(end / name, (start / name).read_bytes())
        result.save(end / RESULTS / f"{result.key}.json")


def tuning_key(spec: RunSpec) -> str:
    """Key of the tuning of ``spec``; equal for runs that differ only in their seed."""
    return run_key(tuning=tuning_spec(spec).key)
