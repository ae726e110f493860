"""The file for the Rerun viewer, read back."""

import numpy as np
import pytest
import torch

from gsfusion_nb import run_mapping
from gsfusion_nb.cli import main


def test_a_continued_run_writes_a_new_file(tmp_path, capsys):
    (tmp_path / "a.rrd").touch()
    assert main(["map", "--resume", str(tmp_path), "--rerun", str(tmp_path / "a.rrd")]) == 1
    assert "a.rrd exists and may hold what was mapped before" in capsys.readouterr().err
    assert (tmp_path / "a.rrd").stat().st_size == 0


def columns(path):
    """Entity -> component -> its values over time, as lists."""
    from rerun.chunk import RrdReader

    found: dict[str, dict[str, list]] = {}
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            found.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(batch.column(name).to_pylist())
    return found


def test_the_file_holds_frames_poses_maps_and_scores(config, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install 'gsfusion-nb[rerun]'")
    from gsfusion_nb.viz.rerun_file import RerunFile

    path = tmp_path / "a.rrd"
    with pytest.raises(ValueError, match=r"must end in \.rrd"):
        RerunFile(tmp_path / "a.txt")
    watch = RerunFile(path, maps_every=4)
    run = run_mapping("room", config, folder=tmp_path / "run", watch=watch, n_frames=120, width=80, height=60)
    found = columns(path)
    n = len(run.run.steps)

    def values(entity, component):
        (name,) = [name for name in found[entity] if name.endswith(component)]
        return [value for value in found[entity][name] if value is not None]

    centres = np.array(values("/world/camera", ":translation")).reshape(n, 3)
    assert np.allclose(centres, torch.stack(run.run.poses)[:, :3, 3].numpy(), atol=1e-6)
    assert np.array(values("/scores/psnr_after_db", ":scalars")).ravel().tolist() == pytest.approx(
        [step.psnr_after_db for step in run.run.steps]
    )
    assert len(values("/world/camera/colour", ":blob")) == len(values("/world/camera/depth", ":buffer")) == n
    gaussians = values("/world/gaussians", ":centers")
    assert len(gaussians) == n // 4 + 1
    assert np.array_equal(np.array(gaussians[-1], np.float32), run.mapper.gaussians.params.xyz_W.numpy())
    scales = np.array(values("/world/gaussians", ":scales")[-1], np.float32)
    assert np.allclose(scales, run.mapper.gaussians.scale_m.numpy(), rtol=1e-6)
    meshes = values("/world/mesh", ":triangle_indices")
    assert 0 < len(meshes[0]) < len(meshes[-1])  # it grows
    assert sorted(set(values("/world/camera", "frame"))) == list(range(1, n + 1))
    final = values("/final/psnr_held_out_db", ":scalars")
    assert np.ravel(final).tolist() == pytest.approx([run.metrics["psnr_held_out_db"]])
