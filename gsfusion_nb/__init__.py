"""Learn, teach and prototype online RGB-D mapping with TSDF fusion and 3D Gaussian splatting."""

import importlib
import os
import sys

# Read by OpenMP when torch loads it. By default its idle threads spin, and on a machine with anything else to do small
# operations then take ten times as long; to wait asleep costs next to nothing.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

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


def _register_summaries() -> None:
    """Show frames, volumes, quadtrees, maps and runs as a picture and a table in IPython (``viz.summaries``)."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if shell is not None:
        html = shell.display_formatter.formatters["text/html"]
        for module, name in _WITH_SUMMARY:
            html.for_type_by_name(
                module, name, lambda x: importlib.import_module("gsfusion_nb.viz.summaries").html_summary(x)
            )


_WITH_SUMMARY = (
    ("gsfusion_nb.types", "Frame"),
    ("gsfusion_nb.tsdf.volume", "TsdfVolume"),
    ("gsfusion_nb.seeding.quadtree", "Cells"),
    ("gsfusion_nb.gaussians.model", "GaussianModel"),
    ("gsfusion_nb.runs.mapping_run", "MappingRun"),
    ("gsfusion_nb.runs.map_sequence", "FinishedRun"),
)

_register_summaries()
