"""A live view of a camera in the map of an earlier run: looked for, and then shown from above."""

import dataclasses
import itertools
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from gsfusion_nb.config import gsfusion
from gsfusion_nb.data.room import room
from gsfusion_nb.runs import run_mapping, stream_onto
from gsfusion_nb.viz import LiveMapper
from gsfusion_nb.viz.map_from_above import drawable, map_from_above

ROOM: dict[str, Any] = {"n_frames": 120, "width": 160, "height": 120}
ORANGE = (255, 150, 30)


@pytest.fixture(scope="module")
def parent(tmp_path_factory) -> Path:
    """The folder of a run on the first frames of the walk."""
    folder = tmp_path_factory.mktemp("parent") / "run"
    config = gsfusion(
        "replica",
        tsdf__voxel_size_m=0.04,
        tsdf__truncation_voxels=4.0,
        sh_degree=0,
        data__hold_out_every=0,
        data__stop=10,
        optim__global_iterations=0,
    )
    run_mapping("room", config, folder=folder, evaluate=False, **ROOM)
    return folder


def camera(indices):
    """Frames of the walk, without poses."""
    source = room(**ROOM)
    for index in indices:
        yield dataclasses.replace(source[index], T_WC=torch.eye(4))


def n_orange(data: bytes) -> int:
    """Pixels of a picture in the colour of the camera."""
    picture = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))[..., ::-1]
    return int((np.abs(picture.astype(int) - ORANGE).max(-1) < 40).sum())


def test_the_place_is_shown_from_above_once_it_is_located(parent):
    run = stream_onto(camera([60, 61, *range(8, 12)]), parent, policy="all")
    live = LiveMapper(run)
    assert "looking for the place in the map" in live.status.value
    assert n_orange(live.images["place"].value) < 20
    before = live.picture()
    assert before.ndim == 3
    assert live.run_sync(1) == 1  # two frames that are nowhere in the map are no steps
    assert live.player.n_steps == 1
    live._draw()
    assert "looking for" not in live.status.value
    assert n_orange(live.images["place"].value) > 100
    live.run_sync()
    assert len(run.steps) == 4
    assert "finished" in live.status.value
    assert live.picture().shape[0] > before.shape[0]


def test_it_can_be_paused_and_stopped_while_it_looks(parent):
    run = stream_onto(camera(itertools.repeat(60)), parent, policy="all")
    live = LiveMapper(run)
    live.player.start()
    end = time.monotonic() + 60
    while "frames so far" not in live.status.value:
        assert time.monotonic() < end, live.status.value
        time.sleep(0.01)
    live.player.pause()
    assert live.player.join(60)
    assert live.player.state == "paused"
    n_looked = run.n_unusable
    live.player.start()
    while run.n_unusable < n_looked + 2:
        assert time.monotonic() < end
        time.sleep(0.01)
    live.stop()
    assert live.player.join(60)
    assert live.player.state == "stopped"
    assert not run.steps
    run.close()


def test_the_camera_is_drawn_where_it_is(parent):
    mapper = stream_onto(camera([]), parent).mapper
    earlier = mapper.trajectory.poses
    ahead = earlier[0].clone()
    ahead[:3, 3] += 0.5 * earlier[0][:3, 2]
    shown = {}
    for name, T_WC in (("there", earlier[0]), ("ahead", ahead)):
        picture = map_from_above(drawable(mapper), earlier, [earlier[0], T_WC], (320, 240))
        assert picture.shape == (240, 320, 3)
        at = np.argwhere((picture == ORANGE).all(-1))
        shown[name] = at.mean(0)
    assert shown["ahead"][0] < shown["there"][0] - 5  # the first view's direction is up
    assert abs(shown["ahead"][1] - shown["there"][1]) < 5
