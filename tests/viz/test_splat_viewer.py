"""The splat viewer without a browser: what is sent, what a pick tells, what a stored notebook
shows."""

import dataclasses

import numpy as np
import pytest
import torch

from gsfusion_nb.config import gps_slam
from gsfusion_nb.drawing.pictures import to_uint8
from gsfusion_nb.mapping import make_mapper
from gsfusion_nb.render import render
from gsfusion_nb.types import Camera, Seeds
from gsfusion_nb.viz import SplatViewer, orbit_camera

CAMERA = Camera(
    width=64,
    height=48,
    fx=60.0,
    fy=60.0,
    cx=32.0,
    cy=24.0,
)
FRONT = orbit_camera((0, 0, 0), -90, 0, 2.0)


@pytest.fixture(autouse=True)
def _watched(monkeypatch):
    for name in ("GSNB_VIEW", "GSNB_SMOKE"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def viewer(model):
    return SplatViewer(model, camera=CAMERA, T_WC=FRONT)


@pytest.fixture
def sent(viewer, monkeypatch):
    """The row messages that left, as (head, index, records)."""
    out = []

    def send(content, buffers=()):
        arrays = [np.frombuffer(b, np.uint8) for b in buffers]
        index = arrays[0].view(np.int32).tolist() if len(arrays) == 2 else None
        out.append((content["head"], index, arrays[-1].reshape(-1, content["head"]["stride"])))

    monkeypatch.setattr(viewer, "send", send)
    return out


def say_ready(viewer):
    viewer._handle_custom_msg({"kind": "ready"}, [])


def more(model, n=1):
    seeds = Seeds.isotropic(
        torch.rand(n, 3),
        torch.rand(n, 3),
        torch.full((n,), 0.1),
        tag=torch.full((n,), 2),
    )
    model.append(seeds, 9)


def test_it_starts_at_the_given_pose_and_camera(viewer):
    assert (viewer.width, viewer.height) == (64, 48)
    assert viewer.intrinsics == [60.0, 60.0, 32.0, 24.0]
    assert torch.allclose(viewer.T_WC, FRONT)
    assert viewer.pivot_m == pytest.approx(2.0, abs=0.3)
    assert torch.allclose(torch.tensor(viewer.up_W), torch.tensor([0.0, 0, 1]))


def test_columns_are_what_is_known(viewer, model):
    by_name = {c["name"]: c for c in viewer.columns}
    assert list(by_name) == ["birth_frame", "tag"]
    assert (by_name["birth_frame"]["low"], by_name["birth_frame"]["high"]) == (3, 7)
    assert viewer.birth_range == [3, 7]
    extras = {"contribution": torch.tensor([0.1, 0.9]), "state": torch.tensor([False, True])}
    rich = SplatViewer(model, extras=extras, colour_by="contribution")
    kinds = {c["name"]: (c["kind"], c["names"]) for c in rich.columns}
    assert kinds["contribution"] == ("number", None)
    assert kinds["state"] == ("state", ["unstable", "stable"])
    bare = SplatViewer(model.params)
    assert bare.columns == bare.birth_range == []


def test_a_mapper_brings_its_camera_and_first_pose(make_run):
    run = make_run()
    next(run.online())
    viewer = SplatViewer(run.mapper)
    frame = run.sequence.mapping[0]
    assert torch.allclose(viewer.T_WC, frame.T_WC)
    assert viewer.up_W == [0, -1, 0]
    assert (viewer.width, viewer.height) == (48, 36)


def test_updates_send_what_is_new(viewer, model, sent, monkeypatch):
    monkeypatch.setattr("gsfusion_nb.viz.splat_viewer.MIN_INTERVAL_S", 0.0)
    say_ready(viewer)
    more(model)
    viewer.update()
    head, index, records = sent[-1]
    assert (head["n"], head["all"], index, len(records)) == (3, False, [2], 1)
    assert viewer.birth_range == [3, 9]
    viewer.update()
    assert len(sent) == 2  # nothing changed
    model.params.xyz_W[0] += 1
    viewer.update()
    assert sent[-1][1] == [0]
    model.keep(torch.tensor([False, True, True]))
    viewer.update()
    assert (sent[-1][0]["n"], sent[-1][0]["all"]) == (2, True)
    say_ready(viewer)  # a second view, or one that missed something
    assert (sent[-1][0]["all"], len(sent[-1][2])) == (True, 2)


def test_a_pick_gives_the_row_and_tells_observers(viewer, model):
    heard = []
    viewer.observe(lambda change: heard.append(change["new"]), "picked")
    assert viewer.picked_row() is None
    viewer.set_state({"picked": 1})  # as the browser sends it
    assert heard == [1]
    row = viewer.picked_row()
    assert row.row == 1
    assert row.xyz_W == pytest.approx((0.5, 0, 0))
    assert row.scale_m == pytest.approx((0.15, 0.15, 0.15))
    assert row.quat == (1, 0, 0, 0)
    assert row.rgb == pytest.approx((0, 1, 0), abs=1e-6)
    assert row.opacity == pytest.approx(0.99)
    assert row.extras == {"birth_frame": 7, "tag": 5}
    assert "0.99" in str(row)
    assert "<th>tag</th><td>5</td>" in row._repr_html_()
    model.keep(torch.tensor([True, False]))
    viewer.update()
    assert viewer.picked_row() is None


def test_the_picture_is_our_renderers(viewer, model):
    expected = render(model.params, CAMERA, FRONT).rgb.numpy() * 255
    assert np.abs(viewer.picture() - expected).max() < 1
    seen = [viewer.picture()]
    for changes in (
        {"colour_by": "depth"},
        {"colour_by": "tag"},
        {"colour_by": "opacity"},
        {"colour_by": "rgb", "size": 2.0},
        {"size": 1.0, "opacity": 0.5},
        {"opacity": 1.0, "background": "#4060ff"},
        {"background": "#000000", "born_until": 3.0},
    ):
        viewer.set_state(changes)
        seen.append(viewer.picture())
    assert len({p.tobytes() for p in seen}) == len(seen)
    assert seen[-1][24, 45, 1] < 10 < seen[0][24, 45, 1]  # the green one is born at frame 7
    assert seen[-2][0, 0].tolist() == [0x40, 0x60, 0xFF]


def test_the_map_is_not_part_of_the_saved_state(viewer):
    say_ready(viewer)
    state = {k: v for k, v in viewer.get_state().items() if k not in ("_esm", "_css")}
    assert len(repr(state)) < 10_000


def test_bad_rows_are_left_out_with_a_sentence(model):
    xyz = model.params.xyz_W.clone()
    xyz[0] = float("nan")
    viewer = SplatViewer(
        dataclasses.replace(model.params, xyz_W=xyz),
        camera=CAMERA,
        T_WC=FRONT,
    )
    assert viewer.notice == "1 of the rows hold NaN or infinite numbers and are not drawn"
    assert viewer.picture()[24, :32, 0].max() < 10  # the red one
    assert viewer.picture()[24, 32:, 1].max() > 200


def test_wrong_input_is_refused_with_a_sentence(model, viewer):
    with pytest.raises(
        TypeError, match="needs a mapper, a GaussianModel or GaussianParams, got dict"
    ):
        SplatViewer({})
    with pytest.raises(
        ValueError, match=r"extras\['error'\] must hold one number per Gaussian, \[2\], got \[3\]"
    ):
        SplatViewer(model, extras={"error": torch.zeros(3)})
    with pytest.raises(ValueError, match="cannot be named 'depth'"):
        SplatViewer(model, extras={"depth": torch.zeros(2)})
    with pytest.raises(
        KeyError, match="no colour_by 'level'; known: birth_frame, depth, opacity, rgb, tag"
    ):
        SplatViewer(model, colour_by="level")
    with pytest.raises(KeyError, match="no colour_by 'state'"):
        viewer.colour_by = "state"


def test_other_places_and_cutting_away(viewer, model):
    viewer.look_from("above")
    assert float(viewer.T_WC[2, 3]) > 0.5
    assert viewer.cut_m > 0
    assert viewer.look_from("photo").T_WC.equal(SplatViewer(model, camera=CAMERA, T_WC=FRONT).T_WC)
    viewer.T_WC = orbit_camera((0, 0, 0), 0, 0, 2.0)  # green in front of red
    assert viewer.picture()[24, 32].argmax() == 1
    viewer.cut_m = 2.0
    assert viewer.picture()[24, 32].argmax() == 0
    with pytest.raises(KeyError, match="below"):
        viewer.look_from("below")


def test_a_map_over_a_surface_is_shown_with_its_surface(small_room):
    mapper = make_mapper(gps_slam("room", data__width=80, data__height=60, tsdf__voxel_size_m=0.05))
    for i in range(2):
        mapper.step(small_room[i])
    viewer = SplatViewer(mapper)
    assert not len(mapper.gaussians)  # all that there is to see is the surface
    drawn = to_uint8(mapper.render(viewer.camera, viewer.T_WC).rgb)
    assert drawn.max() > 60
    assert np.array_equal(viewer.picture(), drawn)
    viewer.cut_m = 0.5
    assert viewer.picture().max() > 60  # as discs
    viewer.colour_by = "surface"
    assert viewer.picture().shape == (60, 80, 3)
