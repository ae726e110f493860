"""A system of the package, or of ``docs/examples``, on a recording with small pictures:
``python docs/measured/example_systems.py SYSTEM RECORDING``."""

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
sys.path[:0] = [str(EXAMPLES), str(EXAMPLES / "egg_fusion/src")]

from egg_fusion import EggFusion  # noqa: E402
from splatam_like import SplatamLike  # noqa: E402

from gsfusion_nb.mapping import get_system  # noqa: E402
from gsfusion_nb.runs import run_mapping  # noqa: E402

FEW_SURFELS = {"share": 0.5, "size_px": 1.5, "min_alpha": 0.9}
"""Options of EGG-Fusion's rule in the kitchen: few and small pictures need more surfels a frame
than published."""
name, recording = sys.argv[1:]
system = get_system({"splatam_like": SplatamLike, "egg_fusion": EggFusion}.get(name, name))
is_room = recording == "room"
is_egg_in_the_kitchen = name == "egg_fusion" and not is_room
preset = "room" if is_room else "scannetpp" if is_egg_in_the_kitchen else "replica"
changes: dict[str, Any] = {"data__width": 160, "data__height": 120, "tracking__poses": "given"}
changes |= {"data__stop": 60} if is_room else {}
changes |= {"seeding__options": FEW_SURFELS} if is_egg_in_the_kitchen else {}
with tempfile.TemporaryDirectory() as folder:
    reader = {"n_frames": 480} if is_room else {}
    config = system.preset(preset, **changes)
    run = run_mapping(recording, config, folder=Path(folder) / "run", **reader)
    print(json.dumps({k: v for k, v in run.metrics.items() if isinstance(v, int | float)}))  # noqa: T201
