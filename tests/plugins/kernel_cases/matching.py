"""Matching of descriptors: those of two views, and those of points near their predicted pixels.

Cases of ``match_features`` and ``found_near``: noisy copies of descriptors, lookalikes and equal distances; points
beside the image and behind the camera; narrow and wide searches; empty sides.
"""

import functools
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from gsfusion_nb.geometry import project
from gsfusion_nb.tracking import Features
from gsfusion_nb.tracking.matching import found_near, match_features

from . import Case, make_frame


def cases() -> Iterator[Case]:
    """Views with many features, with one, and with none."""
    for n, m in ((150, 200), (1, 1), (0, 5), (5, 0)):
        run, operations = functools.partial(_pairs, n, m), ("match_features", "found_near")
        yield Case(name=f"{n} and {m}", operations=operations, run=run, dtypes=(torch.float32,), tolerance=0.0)


def _pairs(n: int, m: int, device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    g, camera = torch.Generator().manual_seed(0), make_frame().camera
    xyz_W = torch.rand(n, 3, generator=g, dtype=torch.float64) * 3 + torch.tensor([-1.5, -1.5, 1.0])
    xyz_W[::7, 2] *= -1
    words = torch.randint(0, 256, (n, 32), generator=g, dtype=torch.uint8)
    copied = torch.arange(m) % max(n, 1)
    seen = words[copied] if n else torch.zeros(m, 32, dtype=torch.uint8)
    noise = torch.randint(0, 256, (m, 32), generator=g, dtype=torch.uint8)
    seen = torch.where(torch.rand(m, 32, generator=g) < 0.1 * (torch.arange(m)[:, None] % 3), noise, seen)
    uv = project(camera, xyz_W)[copied].float() if n else torch.zeros(m, 2)
    view = _view(uv + 2 * torch.randn(m, 2, generator=g), seen)
    results = {"all": match_features(_view(torch.zeros(n, 2), words), view)}
    for radius_px in (1.5, 5.0, 200.0):
        pairs = found_near(camera, xyz_W.numpy(), words.numpy(), view, torch.eye(4), radius_px)
        results[f"near, {radius_px} px"] = torch.from_numpy(np.ascontiguousarray(pairs))
    return results


def _view(uv: Tensor, descriptors: Tensor) -> Features:
    n = len(uv)
    known = torch.zeros(n, dtype=torch.bool)
    return Features(uv=uv, descriptors=descriptors, xyz_C=torch.zeros(n, 3), has_depth=known, sigma_px=torch.ones(n))
