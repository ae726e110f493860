"""Chapter 6's checkers agree with the library; the paper's tables beside a reader's."""

import torch

from gsfusion_nb.config import gsfusion
from gsfusion_nb.course import mapping
from gsfusion_nb.course.stand_ins import chequered_wall
from gsfusion_nb.mapping import GSFusion
from gsfusion_nb.optim import Keyframe


def test_the_reference_step_maps_as_the_library_does():
    ours = mapping._small_mapper()
    theirs = mapping._small_mapper()
    for k in range(3):
        frame = chequered_wall(k)
        n = mapping._map_frame(ours, frame, ours._optimise_view)
        assert n == theirs.step(frame).n_seeds
    torch.testing.assert_close(
        ours.gaussians.params.xyz_W, theirs.gaussians.params.xyz_W, rtol=0, atol=0
    )
    assert len(ours.keyframes) == len(theirs.keyframes) == 1


def test_the_plan_is_the_librarys():
    optim = gsfusion(fidelity="paper_steps").optim
    numbers = (optim.keyframe_iterations, optim.frame_iterations, optim.random_keyframe_iterations)
    assert numbers == (5, 3, 2)  # paper, section IV-A.4, Replica
    assert mapping._plan_frame(51, 3, *numbers, gsfusion().keyframe_min_seeds) == (True, 5, 0)
    assert mapping._plan_frame(50, 3, *numbers, gsfusion().keyframe_min_seeds) == (False, 3, 2)


def test_the_log_tells_key_frames_from_frames():
    mapper = GSFusion()
    log = mapping.Log(mapper)
    frame = chequered_wall(4)
    log(frame)
    log(
        Keyframe(
            index=2,
            rgb_u8=frame.rgb_u8,
            camera=frame.camera,
            T_WC=frame.T_WC,
        )
    )
    assert log.calls == [("frame", 4, 0), ("keyframe", 2, 0)]
