"""A map that begins with Gaussians of a file: they are seen, optimised, and named in the notes of
the run."""

import dataclasses

import pytest
import torch

from gsfusion_nb import run_mapping
from gsfusion_nb.config import rtg_slam
from gsfusion_nb.export import read_gaussian_ply
from gsfusion_nb.types import GaussianParams


def test_the_map_goes_on_where_the_file_ends(whole_run, config, tmp_path):
    began = read_gaussian_ply(whole_run.folder / "gaussians.ply")
    seeding = dataclasses.replace(
        config.seeding, quadtree_largest_m=0.0, thickness=1.0, opacity=0.5
    )
    config = dataclasses.replace(
        config, seeding=seeding, data=dataclasses.replace(config.data, stop=4)
    )
    options = {"evaluate": False, "n_frames": 120, "width": 80, "height": 60}
    file = whole_run.folder / "gaussians.ply"
    run = run_mapping("room", config, folder=tmp_path / "on", from_gaussians=file, **options)
    fresh = run_mapping("room", config, folder=tmp_path / "fresh", **options)
    first = run.run.steps[0]
    rows = run.mapper.gaussians
    assert first.psnr_before_db > fresh.run.steps[0].psnr_before_db + 3
    assert f"the map began with {len(began):,} Gaussians of gaussians.ply" in run.run.warnings
    assert (rows.birth_frame[: len(began)] == -1).all()
    assert len(rows) == len(began) + sum(step.n_seeds for step in run.run.steps)
    assert not torch.equal(
        rows.params.sh[: len(began)],
        began.sh[:, : rows.params.sh.shape[1]],
    )  # optimised


def test_what_cannot_begin_a_map(config, tmp_path):
    bad = GaussianParams(
        xyz_W=torch.full((2, 3), float("nan")),
        log_scale=torch.zeros(2, 3),
        quat=torch.zeros(2, 4),
        opacity_logit=torch.zeros(2),
        sh=torch.zeros(2, 1, 3),
    )
    from gsfusion_nb.mapping import make_mapper

    mapper = make_mapper(config)
    with pytest.raises(ValueError, match="Gaussians to begin with must be finite"):
        mapper.files.begin_with(bad)
    assert len(mapper.gaussians) == 0
    with pytest.raises(ValueError, match="RTG-SLAM cannot begin with Gaussians of another program"):
        make_mapper(rtg_slam("replica")).files.begin_with(bad)
    with pytest.raises(FileNotFoundError, match=r"none\.ply does not exist"):
        run_mapping(
            "room",
            config,
            folder=tmp_path / "run",
            from_gaussians=tmp_path / "none.ply",
            n_frames=120,
        )
