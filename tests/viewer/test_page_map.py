"""A map in a page: what the script unpacks is what was put in, and a smaller map looks like the
large one."""

import base64
import json
import math
import re
import zlib

import numpy as np
import pytest
import torch

from gsfusion_nb.gaussians import GaussianModel
from gsfusion_nb.render import render
from gsfusion_nb.types import Camera, GaussianParams, Seeds
from gsfusion_nb.viewer import splat_rows
from gsfusion_nb.viewer.fewer_rows import merged
from gsfusion_nb.viewer.page_map import page_map, page_script, page_style, waiting_controls
from gsfusion_nb.viewer.viewpoint import orbit_camera

CAMERA = Camera(
    width=64,
    height=48,
    fx=60.0,
    fy=60.0,
    cx=32.0,
    cy=24.0,
)
UP_W = torch.tensor([0.0, 0.0, 1.0])


def carpet(n: int) -> GaussianParams:
    """Discs of an n x n lattice of 1 m, red at x < 0.5, blue beside it."""
    line = (torch.arange(n) + 0.5) / n
    x, y = torch.meshgrid(line, line, indexing="ij")
    xyz = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    red, blue = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])
    rgb = torch.where(xyz[:, :1] < 0.5, red, blue)
    model = GaussianModel(sh_degree=1)
    model.append(Seeds.isotropic(xyz, rgb, torch.full((n * n,), 0.7 / n), opacity=0.95), 0)
    return model.params


def unpacked(data: str) -> tuple[dict, np.ndarray]:
    """What ``page.js`` makes of the data of a map."""
    content = json.loads(data)
    head = content["head"]
    planes = np.frombuffer(zlib.decompress(base64.b64decode(content["rows"])), np.uint8)
    return content, planes.reshape(head["stride"], head["n"]).T


def test_the_rows_of_a_page_are_those_of_the_map():
    params = carpet(6)
    T_WC = orbit_camera((0.5, 0.5, 0.0), 20, 40, 2.0)
    births = torch.arange(len(params)) // 6
    shown = page_map(params, CAMERA, T_WC, UP_W, birth_frames=births)
    content, records = unpacked(shown.data)
    layout = splat_rows.RowLayout(columns=1, harmonics=1)
    fields = np.ascontiguousarray(records).view(layout.dtype)[:, 0]
    assert (shown.n, shown.n_whole, shown.has_fewer) == (36, 36, False)
    assert np.array_equal(fields["xyz_W"], params.xyz_W.numpy())
    assert np.array_equal(fields["columns"][:, 0], births.numpy())
    assert content["head"] == {"n": 36, "stride": 40, "columns": 1, "harmonics": 1, "all": True}
    assert content["state"]["places"]["photo"][0] == pytest.approx(T_WC.flatten().tolist())
    assert content["state"]["pose"] == content["state"]["places"]["above"][0]
    assert content["state"]["birth_range"] == [0.0, 5.0]
    assert shown.has_timeline
    assert shown.poster.shape == (48, 64, 3)
    assert "<" not in shown.data


def test_a_page_of_a_map_of_many_names_the_rows_that_it_stands_for():
    params = carpet(60)
    births = torch.arange(len(params))
    shown = page_map(params, CAMERA, torch.eye(4), UP_W, birth_frames=births, most_rows=300)
    _, records = unpacked(shown.data)
    layout = splat_rows.RowLayout(columns=1, harmonics=1)
    fields = np.ascontiguousarray(records).view(layout.dtype)[:, 0]
    rows = fields["columns"][:, 0].astype(int)
    assert 100 < shown.n <= 300
    assert shown.n_whole == 3600
    distance = np.linalg.norm(fields["xyz_W"] - params.xyz_W.numpy()[rows], axis=1)
    assert distance.max() < 0.3, "a row is far from the one that it stands for"


def test_a_row_that_is_not_finite_is_left_out():
    params = carpet(3)
    params.xyz_W[4, 0] = math.nan
    shown = page_map(params, CAMERA, torch.eye(4), UP_W)
    assert (shown.n, shown.n_whole, shown.has_timeline) == (8, 9, False)


def test_a_smaller_map_looks_like_the_large_one():
    params = carpet(60)
    fewer, rows = merged(params[::2], 300)  # as a page reads a map of so many
    assert 20 < len(fewer) <= 300
    assert torch.allclose(fewer.xyz_W[:, 2], torch.zeros(()), atol=1e-6)
    assert not len(set(rows.tolist())) < len(rows)
    inside = ((fewer.xyz_W[:, 0] - 0.5).abs() > 0.1).nonzero().flatten()
    red = fewer.sh[inside, 0, 0] > 0
    assert torch.equal(red, fewer.xyz_W[inside, 0] < 0.5), "colours were mixed"
    T_WC = orbit_camera((0.5, 0.5, 0.0), 0, 90, 1.0)
    large, small = (render(p, CAMERA, T_WC).rgb for p in (params, fewer))
    error = (large - small).square().mean(-1)[14:34, 22:42]
    beside_border = torch.cat([error[:5], error[15:]])
    assert float(-10 * beside_border.mean().log10()) > 26
    assert float(-10 * error.mean().log10()) > 15, "the border is blurred more than by a cell"


def test_detail_stays_where_the_colours_change():
    """Stripes of 10 cm at x > 0.5; beside them one colour."""
    params = carpet(60)
    stripe = (params.xyz_W[:, 0] * 10).long() % 2 == 0
    is_striped = params.xyz_W[:, 0] > 0.5
    params.sh[:, 0] = torch.where((stripe & is_striped)[:, None], 1.5, -1.5)
    fewer, _ = merged(params, 300)
    n_striped = int((fewer.xyz_W[:, 0] > 0.5).sum())
    assert n_striped > 2 * (len(fewer) - n_striped)


def test_a_map_that_is_small_enough_stays_as_it_is():
    params = carpet(4)
    fewer, rows = merged(params, 16)
    assert torch.equal(fewer.xyz_W, params.xyz_W)
    assert torch.equal(rows, torch.arange(16))
    assert fewer.sh.shape == (16, 1, 3)


def test_the_buttons_under_a_poster_are_those_that_the_map_brings():
    shown = page_map(carpet(4), CAMERA, orbit_camera((0.5, 0.5, 0.0), 20, 40, 2.0), UP_W)
    state = json.loads(shown.data)["state"]
    html = waiting_controls()
    labels = re.findall(r"<button disabled>(\w+)</button>", html)
    assert labels == [*state["places"], "more"]
    assert html.count("<button") == html.count("<button disabled") == len(labels) + 1
    assert 'aria-hidden="true"' in html
    classes = set(re.findall(r"gsnb-splat-\w+", html))
    assert all(f".{name}" in page_style() for name in classes - {"gsnb-splat-timeline"})


def test_the_script_is_whole_and_has_no_end_tag():
    script = page_script()
    assert "</script" not in script
    assert "export default" not in script
    assert script.count("const VIEWER = {") == 1
