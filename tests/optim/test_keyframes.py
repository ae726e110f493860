import tempfile

import torch

from gsfusion_nb.geometry import se3
from gsfusion_nb.optim import KeyframeList, TrainingView
from gsfusion_nb.optim import keyframes as keyframes_module
from gsfusion_nb.resources import MAP_MEMORY
from gsfusion_nb.types import Camera, Frame

CAMERA = Camera(
    width=4,
    height=3,
    fx=4.0,
    fy=4.0,
    cx=2.0,
    cy=1.5,
)


def frame(index: int) -> Frame:
    rgb = (torch.arange(36).reshape(3, 4, 3) + index).float() / 255
    return Frame(
        index=index,
        timestamp_s=0.0,
        rgb=rgb,
        depth_m=torch.ones(3, 4),
        camera=CAMERA,
        T_WC=torch.eye(4),
    )


def keyframes(n: int) -> KeyframeList:
    out = KeyframeList()
    for i in range(n):
        out.append(frame(i))
    return out


def test_images_survive_as_uint8():
    k = keyframes(1)
    assert k[0].rgb_u8.dtype == torch.uint8
    torch.testing.assert_close(k[0].rgb, frame(0).rgb)


def test_draws_are_distinct_seeded_and_bounded():
    k = keyframes(20)
    drawn = [x.index for x in k.draw(5, torch.Generator().manual_seed(3))]
    assert len(set(drawn)) == 5
    assert drawn == [x.index for x in k.draw(5, torch.Generator().manual_seed(3))]
    assert sorted(x.index for x in k.draw(99, torch.Generator())) == list(range(20))
    assert k.draw(0, torch.Generator()) == []
    assert KeyframeList().draw(3, torch.Generator()) == []


def test_every_keyframe_is_drawn_about_equally():
    k = keyframes(10)
    g = torch.Generator().manual_seed(0)
    hits = torch.zeros(10)
    for _ in range(2000):
        for x in k.draw(2, g):
            hits[x.index] += 1
    assert (hits / 2000 - 0.2).abs().max() < 0.04


def test_state_round_trip():
    again = KeyframeList.from_state_dict(keyframes(3).state_dict())
    assert [x.index for x in again] == [0, 1, 2]
    assert again[2].camera == CAMERA
    assert torch.equal(again[1].rgb_u8, keyframes(3)[1].rgb_u8)


def test_depth_is_kept_on_request_only():
    k = KeyframeList()
    k.append(frame(0), with_depth=True)
    k.append(frame(1))
    assert k[0].depth_m is not None
    assert torch.equal(k[0].depth_m, torch.ones(3, 4))
    assert k[1].depth_m is None
    again = KeyframeList.from_state_dict(k.state_dict())
    assert again[0].depth_m is not None
    assert torch.equal(again[0].depth_m, torch.ones(3, 4))
    assert again[1].depth_m is None


def test_a_loop_moves_each_pose_in_the_world(generator):
    k = keyframes(3)
    T = se3.exp(torch.randn(3, 6, generator=generator, dtype=torch.float64))
    before = list(k)
    k.move(T)
    for old, new, T_k in zip(before, k, T, strict=True):
        torch.testing.assert_close(
            new.T_WC.double(),
            T_k @ old.T_WC.double(),
            atol=1e-6,
            rtol=1e-6,
        )
        assert torch.equal(old.T_WC, torch.eye(4))
        assert new.rgb_u8 is old.rgb_u8
    assert torch.equal(k.T_WC, torch.stack([keyframe.T_WC for keyframe in k]))


def test_all_poses_follow_every_change(generator):
    k = keyframes(3)
    assert torch.equal(k.T_WC, torch.eye(4).expand(3, 4, 4))
    T = se3.exp(torch.randn(6, generator=generator))
    before = k.snapshot()
    for change in (
        lambda: k.set_pose(k[1].index, T),
        lambda: k.append(frame(1)),
        lambda: k.restore(before),
    ):
        change()
        assert torch.equal(k.T_WC, torch.stack([keyframe.T_WC for keyframe in k]))
    assert torch.equal(k.T_WC, torch.eye(4).expand(3, 4, 4))


def test_images_are_kept_where_they_are_wanted():
    keyframes = KeyframeList("meta")
    keyframes.append(frame(0), with_depth=True)
    assert {t.device.type for t in vars(keyframes[0]).values() if isinstance(t, torch.Tensor)} == {
        "meta"
    }
    here = KeyframeList("cpu")
    here.append(frame(0), with_depth=True)
    there = KeyframeList.from_state_dict(here.state_dict(), "meta")
    assert there[0].rgb_u8.device.type == "meta"
    assert frame(0).rgb.device.type == "cpu"


def test_images_beyond_what_memory_may_hold_are_in_files(monkeypatch, tmp_path):
    # two images with their depths
    monkeypatch.setattr(keyframes_module, "IN_MEMORY_BYTES", 2 * 36 + 2 * 48)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    in_file = MAP_MEMORY.in_file
    written = []
    monkeypatch.setattr(
        MAP_MEMORY, "in_file", lambda image: written.append(image) or in_file(image)
    )
    k = KeyframeList()
    for i in range(4):
        k.append(frame(i), with_depth=True)
    again = KeyframeList.from_state_dict(k.state_dict())
    assert len(written) == 2 * 2 * 2
    for kept in (k, again):
        assert all(torch.equal(x.rgb_u8, keyframes(4)[i].rgb_u8) for i, x in enumerate(kept))
        assert all(bool((x.depth_m == 1).all()) for x in kept)
    assert list(tmp_path.iterdir()) == []


def test_a_view_without_depth_has_depth_nowhere():
    """Of a frame, a keyframe that kept its depth, and one that did not. All pixels count unless
    some are given."""
    k = KeyframeList()
    k.append(frame(0), with_depth=True)
    k.append(frame(1))
    some = torch.zeros(3, 4, dtype=torch.bool)
    some[1, 2] = True
    for source, depth in ((frame(0), 1.0), (k[0], 1.0), (k[1], 0.0)):
        view = TrainingView.of(source)
        assert torch.equal(view.depth_m, torch.full((3, 4), depth))
        assert view.pixels.all()
        assert view.index == source.index
        assert torch.equal(TrainingView.of(source, some).pixels, some)


def test_files_call_the_exposure_of_a_keyframe_gain():
    k = keyframes(2)
    exposure = torch.tensor([0.5, 1.0, 2.0])
    k.set_exposure(1, exposure)
    state = k.state_dict()
    assert state[0]["gain"] is None
    assert torch.equal(state[1]["gain"], exposure)
    again = KeyframeList.from_state_dict(state)[1].exposure
    assert again is not None
    assert torch.equal(again, exposure)
