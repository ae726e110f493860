"""What a notebook shows of maps on a GPU: every picture is made, and comes to the processor."""

import numpy as np
import pytest
import torch

from gsfusion_nb.config import gsfusion, rtg_slam
from gsfusion_nb.data import open_sequence
from gsfusion_nb.mapping import RTGSLAM, GSFusion, make_mapper
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.viz import LiveMapper, SplatViewer, map_picture, show_mesh
from gsfusion_nb.viz.map_pictures import cause_picture, state_picture
from gsfusion_nb.viz.panels.stage_bars import keyframe_strip
from gsfusion_nb.viz.summaries import html_summary

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")
DATA = {"width": 40, "height": 30, "stop": 6, "hold_out_every": 0}


def run_of(system) -> MappingRun:
    config = {
        "gsfusion": lambda: gsfusion("room", data=DATA, tsdf__voxel_size_m=0.08, seeding__quadtree_threshold=2e-3),
        "rtg_slam": lambda: rtg_slam(
            "room", data=DATA, window={"iterations": 2, "every_frames": 2}, keyframes__iterations=2
        ),
    }[system]()
    source = {"path_or_name": "room"}
    return MappingRun(open_sequence("room", data=config.data), make_mapper(config, device="cuda"), source=source)


@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam"])
def test_live_panels_summaries_and_viewers(system, gpu, monkeypatch):
    monkeypatch.setenv("GSNB_VIEW", "static")
    run = run_of(system)
    live = LiveMapper(run)
    live.player.run_sync(3)
    mapper = run.mapper
    assert len(run.steps) == 3
    frame = run.sequence.mapping[2].to("cuda")
    things = [frame, mapper.gaussians, run] + ([mapper.volume] if isinstance(mapper, GSFusion) else [])
    assert all("data:image" in html_summary(thing) for thing in things)
    pictures = [
        keyframe_strip(mapper.keyframes),
        np.asarray(map_picture(mapper.gaussians.params, frame.camera, frame.T_WC)),
    ]
    if isinstance(mapper, RTGSLAM):
        view = mapper.surface(frame.camera, frame.T_WC)
        pictures.append(state_picture(mapper.gaussians, view, frame.camera, frame.T_WC))
        pictures.append(cause_picture(frame.rgb, mapper.gaussians, frame))
    assert all(p.dtype == np.uint8 and p.std() > 0 for p in pictures)
    assert show_mesh(mapper.mesh()) is not None
    assert SplatViewer(mapper) is not None
    assert torch.equal(frame.rgb.cpu(), run.sequence.mapping[2].rgb)
