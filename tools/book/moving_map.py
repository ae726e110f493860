"""The map of the built-in room that turns on the first page of the book, without a kernel."""

import base64
import json
from pathlib import Path

from gsfusion_nb import GSFusion, gsfusion, open_sequence
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.viz import SplatViewer


def moving_map() -> str:
    """A script that puts the map, seen from above, into every element of the class
    ``gsnb-moving-map``."""
    options = {
        "data__width": 240,
        "data__height": 180,
        "tsdf__voxel_size_m": 0.04,
        "optim__global_iterations": 6,
    }
    config = gsfusion("room", sh_degree=0, seeding__quadtree_threshold=0.02, **options)
    run = MappingRun(open_sequence("room", data=config.data, n_frames=60), GSFusion(config))
    for _ in (*run.online(), *run.optimise()):
        pass
    viewer = SplatViewer(run.mapper, width=480, height=360).look_from("above")
    frames_sent = []
    # what the page would get
    viewer.send = lambda content, buffers: frames_sent.extend((content["head"], *buffers))
    viewer._on_message(None, {"kind": "ready"}, [])
    state = {
        name: value
        for name, value in viewer.get_state().items()
        if name[0] != "_" and name in SplatViewer.__dict__
    }
    rows = base64.b64encode(frames_sent[1]).decode("ascii")
    values = {"STYLE": str(viewer._css), "STATE": state, "HEAD": frames_sent[0], "ROWS": rows}
    constants = "\n".join(f"const {name} = {json.dumps(value)};" for name, value in values.items())
    module = str(viewer._esm).replace("export default {", "const VIEWER = {")
    start = (Path(__file__).parent / "static/moving_map.js").read_text(encoding="utf-8")
    return f"(() => {{\n{module}\n{constants}\n{start}}})();\n"
