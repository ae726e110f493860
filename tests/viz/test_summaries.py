"""What a notebook shows of an object: the numbers are the object's, the picture is one, and IPython finds it."""

import base64
import dataclasses
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest

import gsfusion_nb
from gsfusion_nb import gsfusion
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.data import open_sequence
from gsfusion_nb.gaussians import GaussianModel, SurfelModel
from gsfusion_nb.mapping import make_mapper
from gsfusion_nb.runs import MappingRun
from gsfusion_nb.tsdf import TsdfVolume
from gsfusion_nb.viz import summaries
from gsfusion_nb.viz.summaries import html_summary


@pytest.fixture(scope="module")
def run() -> MappingRun:
    config = gsfusion("room")
    config = dataclasses.replace(config, data=dataclasses.replace(config.data, width=80, height=60))
    made = MappingRun(open_sequence("room", data=config.data, n_frames=20), make_mapper(config))
    steps = made.online()
    for _ in range(2):
        next(steps)
    steps.close()
    return made


def picture(page: str) -> np.ndarray:
    (encoded,) = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page)
    image = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image[..., ::-1]


def test_a_frame_shows_colour_beside_depth(run):
    frame = run.sequence.mapping[0]
    page = html_summary(frame)
    assert "80 × 60" in page
    assert "100 % of the pixels" in page
    shown = picture(page)
    photo = (frame.rgb.numpy() * 255).round().astype(int)
    assert abs(shown[:60, :80].astype(int) - photo).mean() < 8  # JPEG
    assert shown.shape[1] > 160


def test_a_volume_shows_its_extent_and_a_slice(run):
    volume = run.mapper.volume
    page = html_summary(volume)
    size = (volume.block_coords.amax(0) + 1 - volume.block_coords.amin(0)) * volume.block_size_m
    assert " × ".join(f"{s:.2f}" for s in size.tolist()) in page
    assert f"{volume.n_blocks:,}" in page
    shown = picture(page).astype(int)
    assert (shown[..., 2] - shown[..., 0] > 60).any()  # free space is blue
    assert "<img" not in html_summary(TsdfVolume(TsdfConfig()))


def test_a_map_is_seen_from_above(run):
    page = html_summary(run.mapper.gaussians)
    assert f"{len(run.mapper.gaussians):,}" in page
    assert picture(page).max() > 60
    assert "<img" not in html_summary(GaussianModel())
    assert "SurfelModel" in html_summary(SurfelModel(0))


def test_ipython_is_told_of_every_summary_and_of_no_other():
    made = {(kind.__module__, kind.__name__) for kind in summaries._SUMMARIES}
    assert set(gsfusion_nb._WITH_SUMMARY) == made
    assert len(gsfusion_nb._WITH_SUMMARY) == len(made)


def test_ipython_shows_the_summary():
    code = """
from IPython.core.interactiveshell import InteractiveShell
shell = InteractiveShell.instance()
from gsfusion_nb.tsdf import TsdfVolume
from gsfusion_nb.gaussians import SurfelModel
from gsfusion_nb.config import TsdfConfig
for thing in (TsdfVolume(TsdfConfig()), SurfelModel(0)):
    assert "<table" in shell.display_formatter.format(thing)[0]["text/html"], thing
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
