"""Learn, teach and prototype online RGB-D mapping with TSDF fusion and 3D Gaussian splatting."""

import importlib
import os

# Read by OpenMP when torch loads it. By default its idle threads spin, and on a machine with
# anything else to do small operations then take ten times as long; to wait asleep costs next to
# nothing.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from . import interrupts as interrupts  # first, for Ctrl-C while torch is imported
from .types import Camera as Camera
from .types import Frame as Frame
from .types import RenderOutput as RenderOutput
from .types import Seeds as Seeds

__version__ = "0.2.0"

_LAZY = {
    "GSFusion": "gsfusion_nb.mapping",
    "GPSSLAM": "gsfusion_nb.mapping",
    "RTGSLAM": "gsfusion_nb.mapping",
    "gsfusion": "gsfusion_nb.config",
    "gps_slam": "gsfusion_nb.config",
    "rtg_slam": "gsfusion_nb.config",
    "run_mapping": "gsfusion_nb.runs",
    "map_stream": "gsfusion_nb.runs",
    "open_sequence": "gsfusion_nb.data",
    "seeding_rule": "gsfusion_nb.seeding",
    "use_backend": "gsfusion_nb.backends",
}


def __getattr__(name: str):
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'gsfusion_nb' has no attribute {name!r}")


def __dir__():
    return sorted([*globals(), *_LAZY])
