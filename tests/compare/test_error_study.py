"""Where a map is wrong: kinds of pixels by hand, sums over views, and the command."""

import dataclasses
import json
import math

import pytest
import torch

from gsfusion_nb.cli import main as cli
from gsfusion_nb.compare.error_study import (
    add_sums,
    depth_error_m,
    parts_of,
    squared_colour_error,
)
from gsfusion_nb.compare.pixel_kinds import (
    is_at_border,
    is_at_edge,
    is_leaning,
    pixel_kinds,
    share_of_views,
)
from gsfusion_nb.types import Camera, Frame, RenderOutput

CAMERA = Camera(width=40, height=30, fx=40.0, fy=40.0, cx=20.0, cy=15.0)


def view(depth_m: torch.Tensor, x_m: float = 0.0) -> Frame:
    """A grey view from ``x_m`` with this depth."""
    T_WC = torch.eye(4)
    T_WC[0, 3] = x_m
    return Frame(
        index=0,
        camera=CAMERA,
        colour=torch.full((*depth_m.shape, 3), 0.5),
        depth_m=depth_m,
        T_WC=T_WC,
        timestamp_s=0.0,
    )


def wall(x_m: float = 0.0) -> Frame:
    """A wall at 2 m."""
    return view(torch.full((30, 40), 2.0), x_m)


def test_edges_of_the_depth_by_hand():
    """A step of 10 % after column 19: two columns on each side are at it. A step of 4 % is none,
    and neither is a hole."""
    depth_m = torch.full((30, 40), 2.0)
    depth_m[:, 20:] = 2.2
    assert is_at_edge(depth_m).any(dim=0).nonzero().flatten().tolist() == [18, 19, 20, 21]
    depth_m[:, 20:] = 2.08
    assert not is_at_edge(depth_m).any()
    depth_m[10:14, 5:9] = 0
    assert not is_at_edge(depth_m).any()
    depth_m[:, 20:] = 2.2
    along_rows = is_at_edge(depth_m)
    assert torch.equal(is_at_edge(depth_m.T.contiguous()), along_rows.T)


@pytest.mark.parametrize(("degrees", "leans"), [(0.0, False), (57.0, False), (63.0, True)])
def test_a_plane_that_leans_by_hand(degrees, leans):
    """z = 2 + tan(angle) y, with y = v z for the ray (u, v, 1): the normal is at that angle to the
    optical axis, which is about the ray of the middle of the picture."""
    camera = dataclasses.replace(CAMERA, fx=400.0, fy=400.0)
    v = (torch.arange(30) + 0.5 - camera.cy) / camera.fy
    z = 2 / (1 - math.tan(math.radians(degrees)) * v)
    depth_m = z[:, None].expand(30, 40).contiguous()
    frame = dataclasses.replace(view(depth_m), camera=camera)
    assert not is_at_edge(depth_m).any()
    assert is_leaning(frame)[14:16, 19:21].tolist() == [[leans, leans], [leans, leans]]
    assert not is_leaning(view(torch.zeros(30, 40))).any()


def test_the_border_is_a_twentieth_of_the_width():
    assert int((~is_at_border(torch.zeros(30, 40))).sum()) == 26 * 36
    assert not is_at_border(torch.zeros(30, 40))[2, 2]


def test_the_share_of_views_that_show_a_place_by_hand():
    """1 m to the right is 20 pixels at 2 m. A view that measured something nearer does not show the
    wall, nor does one that measured nothing."""
    aside = wall(1.0)
    hidden = view(torch.full((30, 40), 1.9))
    without = view(torch.zeros(30, 40))
    share = share_of_views(wall(), [wall(), aside, hidden, without])
    assert share[:, :20].unique().tolist() == [0.25]
    assert share[:, 20:].unique().tolist() == [0.5]
    behind = wall()
    behind.T_WC[2, 3] = 3.0
    assert share_of_views(wall(), [behind]).max() == 0


def test_errors_are_of_pixels_with_both_depths():
    frame = wall()
    frame.depth_m[0, 0] = 0
    picture = RenderOutput(
        rgb=torch.full((30, 40, 3), 0.7),
        depth_m=torch.full((30, 40), 1.8),
        alpha=torch.full((30, 40), 0.75),
        first_index=None,
        dominant_index=None,
    )
    picture.alpha[0, 1] = 0.4
    error_m = depth_error_m(picture, frame)
    assert error_m[0, :2].isnan().all()
    torch.testing.assert_close(error_m[1], torch.full((40,), 0.4))
    squared = squared_colour_error(picture, frame)
    torch.testing.assert_close(squared, torch.full((30, 40), (51 / 255) ** 2))


def test_sums_and_shares_by_hand():
    """Two views. The second kind has the errors 1 and -3, of 1 + 1 + 3 + 2 in all; a pixel without
    depth error counts nowhere."""
    first = torch.tensor([[1.0, -1.0, torch.nan]])
    second = torch.tensor([[-3.0, 2.0, torch.nan]])
    colour = torch.tensor([[1.0, 0.0, 5.0]])
    every = torch.ones(1, 3, dtype=torch.bool)
    some = torch.tensor([[True, False, True]])
    kinds = {}
    for error_m in (first, second):
        masks = iter([("all pixels", every), ("some", some), ("none", ~every)])
        add_sums(kinds, masks, error_m, colour)
    parts = parts_of(kinds)
    numbers = dataclasses.astuple(parts["some"])
    assert numbers == pytest.approx((2 / 4, 4 / 2, -2 / 2, 4 / 7, 1.0))
    assert parts["all pixels"].depth_l1_m == pytest.approx(7 / 4)
    assert parts["none"].pixels == 0
    assert math.isnan(parts["none"].depth_l1_m)


def test_kinds_of_pixels_part_a_view():
    """Near, middle and far are the pixels that are at no edge, each once."""
    depth_m = torch.full((30, 40), 1.0)
    depth_m[:, 13:] = 2.0
    depth_m[:, 26:] = 3.0
    kinds = dict(pixel_kinds(view(depth_m), [wall()]))
    near, middle, far = (kinds[name] for name in list(kinds)[3:6])
    assert [int(part.any(dim=0).sum()) for part in (near, middle, far)] == [11, 9, 12]
    assert torch.equal(near.int() + middle.int() + far.int(), kinds["elsewhere"].int())
    assert torch.equal(kinds["elsewhere"], ~kinds["at an edge of the depth"])
    assert torch.equal(kinds["in few mapped views"], kinds["elsewhere"] & (depth_m != 2))


def test_the_command_says_where_a_map_is_wrong(tmp_path, capsys):
    arguments = ["study", "errors", "room", "--reader", "n_frames=10", "--out", str(tmp_path)]
    small = ["--set", "data.width=48", "data.height=36", "tsdf.voxel_size_m=0.04"]
    assert cli([*arguments, "--only", "gsf", *small]) == 0
    records = json.loads((tmp_path / "table.json").read_text(encoding="utf-8"))
    whole = records["GSFusion; all pixels"]
    edge = records["GSFusion; at an edge of the depth"]
    elsewhere = records["GSFusion; elsewhere"]
    assert whole["pixels"] == whole["depth_share"] == whole["colour_share"] == 1
    assert edge["pixels"] + elsewhere["pixels"] == pytest.approx(1)
    assert edge["depth_share"] + elsewhere["depth_share"] == pytest.approx(1)
    assert edge["depth_l1_m"] > elsewhere["depth_l1_m"] > 0
    table = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert f"| GSFusion | elsewhere | {100 * elsewhere['pixels']:.0f} |" in table
    assert (tmp_path / "errors.png").read_bytes().startswith(b"\x89PNG")
    assert "GSFusion: depth " in capsys.readouterr().out
    assert cli([*arguments, "--only", "nothing", *small]) == 1
    assert "no system's name contains 'nothing'" in capsys.readouterr().err
    assert cli([*arguments, "--only", "gsf", *small, "data.hold_out_every=0"]) == 1
    assert "set data.hold_out_every" in capsys.readouterr().err
    assert cli([*arguments, "--jobs", "2", *small]) == 1
    assert "leave out --jobs and --dask" in capsys.readouterr().err
