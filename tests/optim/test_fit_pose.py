"""A view whose pose is a little wrong finds its way back to the map."""

import pytest
import torch

from gsfusion_nb import GSFusion, gsfusion, open_sequence
from gsfusion_nb.geometry import se3
from gsfusion_nb.optim import fit_pose
from gsfusion_nb.render import render
from gsfusion_nb.types import GaussianParams


@pytest.fixture(scope="module")
def map_and_frame():
    config = gsfusion(
        "online",
        data__width=80,
        data__height=60,
        data__hold_out_every=0,
        seeding__quadtree_threshold=0.03,
        seeding__quadtree_contrast="std",
        tsdf__voxel_size_m=0.04,
    )
    frames = open_sequence("room", data=config.data, n_frames=240).mapping
    mapper = GSFusion(config)
    for i in range(3):
        mapper.step(frames[i])
    return mapper.gaussians.params, frames[1]


def off_by(a, b):
    """Millimetres and degrees between two poses."""
    xi = se3.log(se3.inverse(a.double()) @ b.double())
    return 1e3 * float(xi[:3].norm()), float(xi[3:].norm().rad2deg())


@pytest.mark.parametrize("axis", range(6))
def test_a_disturbed_pose_is_found_again(map_and_frame, axis):
    params, frame = map_and_frame
    picture = render(params, frame.camera, frame.T_WC).rgb
    xi = torch.zeros(6)
    xi[axis] = 0.01
    fit = fit_pose(params, frame.camera, picture, frame.T_WC @ se3.exp(xi))
    mm, degrees = off_by(frame.T_WC, fit.T_WC)
    assert fit.mse_after < 0.01 * fit.mse_before
    assert mm < 5
    assert degrees < 0.15


def test_the_given_pose_stays_where_nothing_is_better(map_and_frame):
    params, frame = map_and_frame
    empty = GaussianParams(**{name: column[:0] for name, column in vars(params).items()})
    fit = fit_pose(empty, frame.camera, frame.rgb, frame.T_WC)
    assert torch.equal(fit.T_WC, frame.T_WC)
    assert fit.mse_before == fit.mse_after
    with pytest.raises(ValueError, match="evaluations"):
        fit_pose(params, frame.camera, frame.rgb, frame.T_WC, evaluations=0)
