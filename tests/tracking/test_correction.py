"""How frames and Gaussians between keyframes move when the keyframes do."""

import pytest
import torch

from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking.correction import Correction


def poses(*twists):
    return se3.exp(torch.tensor(twists, dtype=torch.float64))


def correction(old, new, index=(10, 20, 40)):
    return Correction(
        frame_index=torch.tensor(index[: len(old)], dtype=torch.int64),
        T_WC_old=old,
        T_WC_new=new,
        loops=[],
        error_before=1.0,
        error_after=0.5,
    )


OLD = [(0.0, 0, 0, 0, 0, 0), (1.0, 0, 0, 0, 0.1, 0), (2.0, 0, 0, 0, 0.2, 0)]
NEW = [(0.0, 0, 0, 0, 0, 0), (1.0, 0.1, 0, 0, 0.15, 0), (2.0, 0.3, 0, 0, 0.3, 0.1)]


def test_at_keyframes_it_is_new_times_old_inverse():
    old, new = poses(*OLD), poses(*NEW)
    D = correction(old, new).transform_of(torch.tensor([40, 10, 20]))
    torch.testing.assert_close(D @ old[[2, 0, 1]], new[[2, 0, 1]], atol=1e-9, rtol=0)


def test_before_the_first_and_after_the_last_it_is_theirs():
    old, new = poses(*OLD), poses(*NEW)
    c = correction(old, new[[1, 0, 2]])
    torch.testing.assert_close(c.transform_of(torch.tensor([0, 99])), c.transform_of(torch.tensor([10, 40])))


def test_between_two_shifts_it_is_their_mean():
    old = poses(*OLD[:2])
    shift = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    shift[0, 0, 3], shift[1, 0, 3] = 0.1, 0.3
    D = correction(old, shift @ old).transform_of(torch.tensor([15, 12]))
    torch.testing.assert_close(D[:, 0, 3], torch.tensor([0.2, 0.14], dtype=torch.float64), atol=1e-9, rtol=0)


def test_between_two_turns_it_turns_half_about_the_camera():
    """Both keyframes stand at the same place far from the origin; only the later one turns, about itself."""
    old = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    old[:, :3, 3] = torch.tensor([100.0, 0, 0])
    new = old.clone()
    new[1] = old[1] @ poses((0, 0, 0, 0, 0, 0.2))[0]
    D = correction(old, new).transform_of(torch.tensor([15]))[0]
    torch.testing.assert_close(D @ old[0], old[0] @ poses((0, 0, 0, 0, 0, 0.1))[0], atol=1e-9, rtol=0)


def test_exactly_the_identity_where_nothing_moved():
    old = poses(*OLD)
    new = old.clone()
    new[2] = poses(NEW[2])[0]
    D = correction(old, new).transform_of(torch.arange(0, 21))
    assert torch.equal(D, torch.eye(4, dtype=torch.float64).expand(21, 4, 4))


def test_result_is_rigid():
    D = correction(poses(*OLD), poses(*NEW)).transform_of(torch.arange(50))
    R = D[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R), atol=1e-12, rtol=0)


@pytest.mark.parametrize("keyframes", [0, 1])
def test_none_and_one_keyframe(keyframes):
    old = poses(*OLD)[:keyframes]
    D = correction(old, poses(NEW[2]).expand(keyframes, 4, 4)).transform_of(torch.tensor([3, 10, 50]))
    assert D.shape == (3, 4, 4)
    torch.testing.assert_close(D[0], D[2])
