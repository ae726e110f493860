"""Kernels that another process compiles on another core, before they are needed."""

import os
import subprocess
import sys

from ..backends import chosen, is_compiled

_OPERATION = "render_over_base"
"""An operation that GPS-SLAM alone uses: if its kernels are on disk, the others are."""


class CompileAhead:
    """Compiles what GPS-SLAM and scores need, in a process of its own, while this one works.

    Two processes that need the same kernel do not compile it twice: one waits for the other. Where
    the kernels are on disk already, or do not run here, nothing is started.
    """

    def __init__(self):
        self._process: subprocess.Popen | None = None
        if chosen() not in ("auto", "numba") or is_compiled(_OPERATION):
            return
        code = f"from {__name__} import compile_all; compile_all()"
        self._process = subprocess.Popen(
            [sys.executable, "-c", code],
            env=os.environ | {"GSFUSION_BACKEND": chosen()},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def __enter__(self) -> "CompileAhead":
        return self

    def __exit__(self, *_: object) -> None:
        """What is not compiled yet is compiled by whoever needs it."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait()


def compile_all() -> None:
    """What the other process does: kernels in another order than a run of GSFusion needs them, and
    the list of fonts that graphs need."""
    import matplotlib.font_manager  # noqa: F401  (makes the list, once for a user)
    import torch

    from ..config import gps_slam
    from ..optim import dssim_vjp
    from .doctor import map_examples

    torch.set_num_threads(1)
    picture = torch.zeros(32, 32, 3)
    dssim_vjp(picture, picture)
    map_examples([gps_slam("room", tsdf={"voxel_size_m": 0.05}, schedule__every_frames=2)])
