"""Warn if the disk may be too small for what a run will write."""

import logging
from pathlib import Path

from ..files import free_space
from .mapping_run import MappingRun

log = logging.getLogger(__name__)

_BASE_BYTES = 50_000_000
_BYTES_PER_PIXEL = 16
"""Bytes that a frame adds per pixel to maps and checkpoints, averaged over the runs of docs/trust.md."""


def estimated_bytes(run: MappingRun) -> int:
    """Rough estimate of how much a run writes, including checkpoints; half or twice as much is usual."""
    camera, frames = run.sequence.camera, len(run.sequence.mapping)
    return _BASE_BYTES + _BYTES_PER_PIXEL * camera.width * camera.height * frames


def warn_of_little_space(run: MappingRun, folder: Path) -> None:
    """Add a warning to the run if the free disk space is less than it may need."""
    need, free = estimated_bytes(run), free_space(folder)
    if free < need:
        sentence = f"only {free / 1e6:.0f} MB are free in {folder}, and this run may need about {need / 1e6:.0f} MB"
        run.warnings.append(sentence)
        log.warning(sentence)
