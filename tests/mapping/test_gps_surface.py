"""A GPS-SLAM map as standard Gaussians: its surface as discs, in the viewer, in exported files."""

from typing import Any

import pytest
import torch

from gsfusion_nb.config import gps_slam
from gsfusion_nb.evaluation import psnr
from gsfusion_nb.geometry.spherical_harmonics import SH_C0
from gsfusion_nb.mapping import gps_surface
from gsfusion_nb.mapping.gps_surface import CAMERA, fit_to_pictures, plain_gaussians, surface_discs
from gsfusion_nb.render import render
from gsfusion_nb.runs import FinishedRun, run_mapping
from gsfusion_nb.tsdf import extract_mesh
from gsfusion_nb.types import Mesh

ROOM: dict[str, Any] = {"n_frames": 480, "width": 80, "height": 60}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> FinishedRun:
    """Few pixels, so more of them are seeded than usual."""
    config = gps_slam(
        "room",
        data__width=0,
        data__height=0,
        data__stop=14,
        data__hold_out_every=0,
        tsdf__voxel_size_m=0.03,
        final__passes=0,
        seeding__options={"colour_error": 0.03, "share": 0.25, "max_weight": 1.0, "in_holes": True},
    )
    return run_mapping(
        "room", config, folder=tmp_path_factory.mktemp("baked") / "run", evaluate=False, **ROOM
    )


def test_the_discs_are_those_of_a_mesh_that_is_at_hand(run, monkeypatch):
    files = run.run.mapper.files
    mesh = run.run.mapper.mesh()
    files.forget_discs()
    wanted = files.standard_gaussians()
    files.forget_discs()
    monkeypatch.setattr(gps_surface, "extract_mesh", None)
    got = files.standard_gaussians(mesh)
    assert all(torch.equal(column, vars(wanted)[name]) for name, column in vars(got).items())


def test_the_discs_show_the_surface_and_a_fit_shows_it_better(run):
    mapper = run.run.mapper
    poses = list(mapper.trajectory.poses)
    rows = mapper.files.standard_gaussians()
    n = len(mapper.gaussians)
    assert len(rows) > n > 20
    wanted = mapper.render(CAMERA, poses[3]).rgb
    seen = wanted.sum(-1) > 0

    def db(params):
        return psnr(
            render(params, CAMERA, poses[3]).rgb[seen][None],
            wanted[seen][None],
        )

    plain = db(rows)
    assert plain > db(mapper.gaussians.params) + 5
    better = fit_to_pictures(rows, mapper.render, poses, 12)
    assert db(better) > plain + 1
    assert torch.equal(better.xyz_W, rows.xyz_W)


def test_a_gaussian_in_front_of_an_opaque_surface_is_blended_alike(run):
    """o / (1 + o) in front of C_s is (C_s + o c) / (1 + o)."""
    mapper = run.run.mapper
    o = mapper.gaussians.params.opacity_logit.sigmoid()
    over = plain_gaussians(mapper.volume, mapper.gaussians.params)[: len(o)]
    torch.testing.assert_close(over.opacity_logit.sigmoid(), o / (1 + o))
    D, known = mapper.volume.interpolate(over.xyz_W)
    before, _ = mapper.volume.interpolate(mapper.gaussians.params.xyz_W)
    assert float((D - before)[known].min()) > -0.05
    assert float(D[known].median()) > 0.15


def test_discs_lie_flat_on_the_mesh(run):
    mesh = extract_mesh(run.run.mapper.volume)
    discs = surface_discs(mesh, 0.03)
    assert 0.2 * len(mesh.vertices_W) < len(discs) < len(mesh.vertices_W)
    assert discs.log_scale[:, 2].max() < discs.log_scale[:, 0].min()
    empty = Mesh(
        vertices_W=torch.zeros(0, 3),
        faces=torch.zeros(0, 3, dtype=torch.int32),
        rgb=torch.zeros(0, 3),
    )
    assert len(surface_discs(empty, 0.03)) == 0


def test_a_disc_has_the_mean_place_and_colour_of_its_voxel():
    mesh = Mesh(
        vertices_W=torch.tensor(
            [
                [0.1, 0.1, 0.5],
                [0.3, 0.1, 0.5],
                [0.1, 0.3, 0.5],
                [2.5, 0.0, 0.5],
            ]
        ),
        faces=torch.tensor([[0, 1, 2]], dtype=torch.int32),
        rgb=torch.tensor(
            [
                [0.2, 0.0, 0.0],
                [0.4, 0.3, 0.0],
                [0.6, 0.3, 0.9],
                [1.0, 1.0, 0.0],
            ]
        ),
    )
    discs = surface_discs(mesh, 1.0)
    near, far = discs.xyz_W[:, 0].argsort()
    torch.testing.assert_close(discs.xyz_W[near], torch.tensor([0.5 / 3, 0.5 / 3, 0.5]))
    rgb = 0.5 + SH_C0 * discs.sh[:, 0]
    torch.testing.assert_close(rgb[near], torch.tensor([0.4, 0.2, 0.3]))
    torch.testing.assert_close(rgb[far], mesh.rgb[3])
