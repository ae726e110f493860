"""One iteration of ICP and one step on a pose graph: the recorded numbers are those of the
operation."""

import dataclasses
import math

import pytest
import torch
from matplotlib.figure import Figure

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TrackingConfig
from gsfusion_nb.geometry import se3
from gsfusion_nb.tracking import icp
from gsfusion_nb.tracking.edges import Edge, odometry_information
from gsfusion_nb.tracking.pose_graph import optimise_poses
from gsfusion_nb.viz import displaced_pose, frame_surface, icp_stepper, pose_graph_stepper
from gsfusion_nb.viz.steppers import icp as icp_stepper_module


def find(stepper, title):
    """Number of the first step whose title contains a text."""
    return next(k for k, step in enumerate(stepper.steps) if title in step.title)


def test_icp_ends_with_the_pose_of_one_iteration(frame, press):
    surface = frame_surface(frame)
    start = displaced_pose(frame.T_WC, 0.03, 0.0)
    stepper = icp_stepper(frame.depth_m, frame.camera, surface, start, factor=2, pixels=2)
    steps = press(stepper)
    once = dataclasses.replace(TrackingConfig(), pyramid=(2,), iterations=(1,))
    with use_backend("reference"):
        result = icp(frame.depth_m, frame.camera, surface, start, once)
    moved = stepper.steps[find(stepper, "The pose is moved")].line["T_WC"]
    torch.testing.assert_close(moved, result.T_WC)
    assert steps[-1][1]["rms after"] == f"{1000 * result.rms_m:.2f} mm, {result.n_inliers} pairs"
    row = stepper.steps[find(stepper, "Only the distance")].scene
    r_mm = 1000 * float((row["p"] - row["q"]) @ row["n"])
    assert steps[find(stepper, "Only the distance")][1]["r = (p − q) . n"] == f"{r_mm:.2f} mm"
    far = displaced_pose(frame.T_WC, 50.0, 0.0)
    with pytest.raises(ValueError, match="gates"):
        icp_stepper(frame.depth_m, frame.camera, surface, far, factor=2)


def test_a_stored_notebook_shows_the_pair_and_the_sums(frame, monkeypatch):
    """Evenly spread steps showed neither; what is not known yet has no empty frame."""
    monkeypatch.setenv("GSNB_VIEW", "static")
    start = displaced_pose(frame.T_WC, 0.03, 0.0)
    stepper = icp_stepper(frame.depth_m, frame.camera, frame_surface(frame), start, factor=2)
    _, metadata = stepper._repr_mimebundle_()
    shown = metadata["image/png"]["alt"]
    titles = ("The surface's point q and normal n", "H = sum w J^T J", "One iteration is done")
    assert all(title in shown for title in titles)

    def frames(title):
        figure = Figure()
        icp_stepper_module._icp_picture(figure, stepper.steps[find(stepper, title)].scene)
        return [axes.get_title(loc="left") or axes.get_title() for axes in figure.axes]

    assert len(frames("its point p")) == 1
    assert frames(titles[0])[1:] == ["p, q and the plane of q"]
    assert frames(titles[1])[1:] == ["H (blue +, red −)"]


@pytest.fixture
def loop():
    """Five poses around a square and the first corner again, with a bend in the odometry that the
    loop contradicts."""
    turn = torch.tensor(
        [1.0, 0, 0, 0, 0, math.pi / 2],
        dtype=torch.float64,
    )
    step = se3.exp(turn)
    bend = se3.exp(torch.tensor([0.04, 0.02, 0, 0, 0, 0.05], dtype=torch.float64))
    poses = [torch.eye(4).double()]
    edges = []
    for k in range(4):
        T_ij = step @ bend
        edges.append(
            Edge(
                i=k,
                j=k + 1,
                T_ij=T_ij,
                information=odometry_information(3.0, 0.05),
                kind="odometry",
            )
        )
        poses.append(poses[-1] @ T_ij)
    T_loop = se3.inverse(poses[0]) @ torch.linalg.matrix_power(step, 4)
    edges.append(
        Edge(
            i=0,
            j=4,
            T_ij=T_loop,
            information=odometry_information(1.0, 0.02),
            kind="loop",
        )
    )
    return torch.stack(poses), edges


def test_pose_graph_ends_with_the_poses_of_one_step(loop, press):
    T_WC, edges = loop
    stepper = pose_graph_stepper(T_WC, edges)
    steps = press(stepper)
    moved = stepper.steps[-1].scene["T_WC"]
    torch.testing.assert_close(moved[0], T_WC[0])
    without_loops = [dataclasses.replace(e, kind="odometry") for e in edges]
    once = optimise_poses(T_WC, without_loops, iterations=1)
    alone = pose_graph_stepper(T_WC, without_loops)
    torch.testing.assert_close(alone.steps[-1].scene["T_WC"], once.T_WC)
    assert float(
        {row[0]: row[1] for row in alone.steps[-1].numbers}["error after"]
    ) == pytest.approx(once.error_after, rel=1e-3)
    H = stepper.steps[find(stepper, "Solve H xi")].scene["H"] > 0
    joined = torch.eye(5, dtype=torch.bool)
    for e in edges:
        joined[e.i, e.j] = joined[e.j, e.i] = True
    assert (joined == H).all()
    assert float(steps[-1][1]["error after"]) < float(steps[-1][1]["error before"])
    with pytest.raises(ValueError, match="two poses"):
        pose_graph_stepper(T_WC, [])
