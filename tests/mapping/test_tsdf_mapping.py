"""Frames that a loop moves, the tracked loop, and landmarks only where they are used."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import pytest
import torch

from gsfusion_nb.config import gps_slam, gsfusion, rtg_slam
from gsfusion_nb.data.room import room
from gsfusion_nb.errors import BadFrameError
from gsfusion_nb.evaluation import ate_rmse
from gsfusion_nb.geometry import se3
from gsfusion_nb.mapping import GPSSLAM, RTGSLAM, GSFusion
from gsfusion_nb.seeding import MapRule, SeedContext, Seeds, copy_memory
from gsfusion_nb.tracking import Correction, loop_finder
from gsfusion_nb.tracking import back_end as back_end_module
from gsfusion_nb.tsdf import TsdfVolume, integrate
from gsfusion_nb.types import Frame

TRACKING = {"poses": "tracked", "back_end": True}
VOXEL_M = 0.04


@pytest.fixture(scope="module")
def frames():
    sequence = room(n_frames=240, width=80, height=60)
    return [sequence[i] for i in range(3)]


def mapped(frames, tracking=TRACKING):
    mapper = GSFusion(gsfusion("room", tracking=tracking, tsdf__voxel_size_m=VOXEL_M))
    for frame in frames:
        mapper.step(frame)
    return mapper


def correct(mapper, shift_m):
    """A loop that moves the last frame sideways, the frame before it half as far, and the first one
    not at all."""
    old = torch.stack([mapper.trajectory.poses[0], mapper.trajectory.poses[-1]]).double()
    new = torch.stack(
        [
            old[0],
            se3.translate(
                old[1],
                torch.tensor([shift_m, 0, 0], dtype=torch.float64),
            ),
        ]
    )
    ends = torch.tensor([mapper.trajectory.frame_indices[i] for i in (0, -1)])
    found = Correction(frame_index=ends, T_WC_old=old, T_WC_new=new, loops=[])
    mapper.localiser._apply(found)


def assert_fused_at(mapper, frames, poses):
    expected = TsdfVolume(mapper.config.tsdf)
    for f, T_WC in zip(frames, poses, strict=True):
        integrate(expected, Frame(**{**vars_of(f), "T_WC": T_WC}))
    rows = expected.index.rows
    order = mapper.files.order_of_rows("tsdf")
    columns = {name: column[order] for name, column in mapper.files.maps()["tsdf"].items()}
    assert torch.equal(columns["block_coords"], expected.block_coords[rows])
    torch.testing.assert_close(columns["D"], expected.D[rows])
    torch.testing.assert_close(columns["W"], expected.W[rows])
    torch.testing.assert_close(columns["rgb"], expected.rgb_planes[rows])


def vars_of(frame):
    return {
        name: getattr(frame, name)
        for name in ("index", "timestamp_s", "colour", "depth_m", "camera", "T_WC")
    }


def test_the_volume_is_that_of_the_corrected_poses(frames):
    mapper = mapped(frames)
    tracked = list(mapper.trajectory.poses)
    correct(mapper, 0.3 * VOXEL_M)
    assert_fused_at(mapper, frames, tracked)  # less than half a voxel
    correct(mapper, 2 * VOXEL_M)
    assert_fused_at(mapper, frames, mapper.trajectory.poses)
    moved_m = [
        float((a - b)[:3, 3].norm()) for a, b in zip(mapper.trajectory.poses, tracked, strict=True)
    ]
    assert not mapper.trajectory.is_refined  # a loop is no refinement by pictures
    assert moved_m == pytest.approx([0, 1.15 * VOXEL_M, 2.3 * VOXEL_M], abs=1e-5)


def test_the_window_of_rtg_slam_and_the_tracker_move_with_a_loop(frames):
    mapper = RTGSLAM(rtg_slam("room", tracking=TRACKING))
    for frame in frames:
        mapper.step(frame)
    assert [f.index for f in mapper.window] == mapper.trajectory.frame_indices
    before = mapper.trajectory.poses[-1].clone()
    correct(mapper, 0.05)
    for frame, T_WC in zip(mapper.window, mapper.trajectory.poses, strict=True):
        torch.testing.assert_close(frame.T_WC, T_WC)
    torch.testing.assert_close(
        mapper.trajectory.poses[-1][:3, 3] - before[:3, 3],
        torch.tensor([0.05, 0, 0]),
    )
    last = mapper.localiser._tracker._path.last
    assert last is not None
    torch.testing.assert_close(
        last.T_WC.float(),
        mapper.trajectory.poses[-1],
        atol=1e-5,
        rtol=0,
    )


def test_a_state_goes_on_with_its_frames(frames):
    mapper = mapped(frames)
    again = GSFusion.from_state_dict(mapper.state_dict())
    for m in (mapper, again):
        correct(m, 2 * VOXEL_M)
    assert_fused_at(again, frames, mapper.trajectory.poses)


def test_no_frame_is_kept_that_no_loop_may_move(frames):
    assert len(mapped(frames[:1], {"poses": "tracked", "back_end": False}).fused) == 0


@dataclass(frozen=True, kw_only=True)
class Remembering(MapRule):
    """The quadtree's cells, of which it remembers every place, and the poses."""

    def seeds(self, ctx: SeedContext, memory: dict[str, Any]) -> Seeds:
        """All cells."""
        seeds = ctx.cells()
        frame = torch.full((len(seeds),), ctx.frame.index)
        toward = (ctx.frame.T_WC[:3, 3] - seeds.xyz_W) / 2
        poses = ctx.frame.T_WC[None]
        indices = frame[:1]
        if memory:
            (old,) = memory["seen"]
            frame = torch.cat([old["frame_index"], frame])
            poses = torch.cat([memory["T_WC"], poses])
            indices = torch.cat([memory["frame_index"], indices])
            toward = torch.cat([old["normal_W"], toward])
        xyz_W = seeds.xyz_W if not memory else torch.cat([old["xyz_W"], seeds.xyz_W])
        memory["seen"] = [{"xyz_W": xyz_W, "normal_W": toward, "frame_index": frame}]
        memory.update(T_WC=poses, frame_index=indices)
        return seeds


def test_what_a_rule_remembers_of_the_world_moves_with_the_gaussians(frames):
    config = gsfusion("room", tracking=TRACKING, tsdf__voxel_size_m=VOXEL_M, optim__lr_xyz=0.0)
    mapper = GSFusion(config, seeding=Remembering)
    for frame in frames:
        mapper.step(frame)
    (seen,) = mapper.rule_in_use.memory["seen"]
    before = copy_memory(mapper.rule_in_use.memory)
    torch.testing.assert_close(seen["xyz_W"], mapper.gaussians.params.xyz_W)
    correct(mapper, 2 * VOXEL_M)
    (seen,) = mapper.rule_in_use.memory["seen"]
    torch.testing.assert_close(seen["xyz_W"], mapper.gaussians.params.xyz_W)
    assert not torch.equal(seen["xyz_W"], before["seen"][0]["xyz_W"])
    poses = torch.stack(mapper.trajectory.poses)
    torch.testing.assert_close(mapper.rule_in_use.memory["T_WC"], poses)
    torch.testing.assert_close(
        seen["xyz_W"] + 2 * seen["normal_W"], poses[seen["frame_index"], :3, 3]
    )


def test_gps_slam_looks_at_the_new_volume_from_the_corrected_poses(frames):
    mapper = GPSSLAM(
        gps_slam("room", tracking=TRACKING, tsdf__voxel_size_m=VOXEL_M, views__every_frames=1)
    )
    for frame in frames:
        mapper.step(frame)
    old_discs = mapper.files.standard_gaussians().xyz_W
    assert len(mapper.views) > 0
    correct(mapper, 2 * VOXEL_M)
    poses = mapper.trajectory.poses
    assert_fused_at(mapper, frames, poses)
    assert len(mapper.views) == 0  # what they saw was the old volume
    discs = mapper.files.standard_gaussians().xyz_W
    assert discs.shape != old_discs.shape or not torch.allclose(discs, old_discs)
    for frame, T_WC in zip(frames, poses, strict=True):
        assert torch.equal(
            next(k for k in mapper.keyframes if k.index == frame.index).T_WC,
            T_WC,
        )
    expected = mapper.surface(frames[2].camera, poses[2])
    _ = list(mapper.global_optimise(1))
    seen = mapper.surface_picture(frames[2].camera, poses[2])
    torch.testing.assert_close(seen.base.depth_m, expected.depth_m)


LOOP = {"poses": "tracked", "landmarks": True, "back_end": True}


@pytest.fixture(scope="module")
def there_and_back():
    """Eight frames of a fast walk, and the same views on the way back."""
    sequence = room(n_frames=240, width=160, height=120)
    there = [sequence[i] for i in range(8)]
    back = [dataclasses.replace(f, index=15 - f.index) for f in reversed(there)]
    return [dataclasses.replace(f, timestamp_s=0.1 * f.index) for f in (*there, *back)]


def mapper_of(system: str) -> Any:
    if system == "gsfusion":
        return GSFusion(gsfusion("room", tracking=LOOP, tsdf__voxel_size_m=0.04))
    return RTGSLAM(rtg_slam("room", tracking=LOOP, window__iterations=4, keyframes__iterations=2))


@pytest.mark.parametrize("system", ["gsfusion", "rtg_slam"])
def test_a_loop_closes_and_a_loss_is_overcome(there_and_back, system, monkeypatch):
    """After the way back the camera is covered, then shown another part of the way, half a metre
    away."""
    monkeypatch.setattr(loop_finder, "MIN_GAP", 3)
    monkeypatch.setattr(back_end_module, "KEYFRAME_DEG", 4.0)
    monkeypatch.setattr(back_end_module, "CORRECT_FROM_M", 0.0)
    mapper = mapper_of(system)
    for frame in there_and_back:
        mapper.step(frame)
    localiser = mapper.localiser
    back_end = localiser.memory.back_end
    closed = [
        (back_end.database.index[e.j], back_end.database.index[e.i])
        for e in back_end.edges
        if e.kind == "loop"
    ]
    assert any(late >= 11 and early <= 4 for late, early in closed)
    true = torch.stack([f.T_WC for f in there_and_back]).double()
    assert ate_rmse(torch.stack(localiser.trajectory.poses).double(), true) < 0.01

    last = there_and_back[-1]
    far = there_and_back[6]
    covered = dataclasses.replace(
        last, index=16, timestamp_s=1.6, depth_m=torch.zeros_like(last.depth_m)
    )
    with pytest.raises(BadFrameError, match="frame 16 cannot be mapped"):
        mapper.step(covered)
    mapper.step(dataclasses.replace(far, index=17, timestamp_s=1.7))
    degrees, metres = se3.motion(localiser.trajectory.poses[-1], far.T_WC)
    assert metres < 0.02
    assert degrees < 0.5


def test_a_tsdf_that_cannot_be_made_again_stays_and_says_so(frames, monkeypatch):
    mapper = mapped(frames)
    before = mapper.volume

    def no_room(*_):
        raise MemoryError("no room for 7 blocks")

    monkeypatch.setattr(type(mapper.fused), "fused_again", no_room)
    correct(mapper, 2 * VOXEL_M)
    assert mapper.volume is before
    last = mapper.trajectory.frame_indices[-1]
    assert mapper.notes[-1] == (
        f"the TSDF stays as it was before the loop at frame {last}: no room for 7 blocks"
    )


def test_a_frame_that_was_recorded_is_not_taken_back(frames):
    mapper = mapped(frames)
    before = mapper.localiser._tracker.standing
    mapper.localiser.take_back()
    after = mapper.localiser._tracker.standing
    assert all(a is b for a, b in zip(after, before, strict=True))
