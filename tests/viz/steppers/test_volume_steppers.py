"""Marching cubes, raycast and quadtree: the recorded numbers are those of the operation."""

import numpy as np
import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.seeding import quadtree
from gsfusion_nb.tsdf import extract_mesh, raycast
from gsfusion_nb.viz import marching_cubes_stepper, quadtree_stepper, raycast_stepper
from gsfusion_nb.viz.steppers.marching_cubes import cut_out, row_of_cells


def find(stepper, title):
    """Number of the first step whose title contains a text."""
    return next(k for k, step in enumerate(stepper.steps) if title in step.title)


@pytest.mark.parametrize("cells", [1, 3])
def test_marching_cubes_has_the_vertices_of_the_mesh(volume, press, cells):
    start = row_of_cells(volume, cells)
    stepper = marching_cubes_stepper(volume, cells=cells)
    steps = press(stepper)
    with use_backend("reference"):
        mesh = extract_mesh(cut_out(volume, start, cells))
        whole = extract_mesh(volume)
    assert steps[-1][1] == {
        "vertices": str(len(mesh.vertices_W)),
        "triangles": str(len(mesh.faces)),
    }
    points = (
        stepper.steps[-1].scene["points"] + np.array(start) + 0.5
    ) * volume.config.voxel_size_m
    np.testing.assert_allclose(points, mesh.vertices_W.numpy(), atol=1e-6)
    assert (torch.cdist(mesh.vertices_W.double(), whole.vertices_W.double()).amin(1) < 1e-6).all()
    cased = [numbers["case"] for title, numbers in steps if title.startswith("The case")]
    assert len(cased) == cells
    D = stepper.steps[0].scene["D"][0]
    assert cased[0].startswith(f"{sum(2**c for c in range(8) if D[c] < 0)} = ")


def test_marching_cubes_refuses_cells_that_are_not_there(volume):
    with pytest.raises(ValueError, match="not allocated"):
        marching_cubes_stepper(volume, (9999, 0, 0))


def test_raycast_ends_at_the_depth_of_the_pixel(volume, frame, press):
    with use_backend("reference"):
        depth_m = raycast(volume, frame.camera, frame.T_WC).depth_m
    v, u = (int(x) for x in (depth_m > 0).nonzero()[200])
    stepper = raycast_stepper(volume, frame.camera, frame.T_WC, (u, v))
    steps = press(stepper)
    assert float(steps[-1][1]["depth z"].removesuffix(" m")) == pytest.approx(
        float(depth_m[v, u]), abs=1e-5
    )
    change = find(stepper, "D changes from + to −")
    assert stepper.steps[change].line.text.startswith("leaves =")
    last = stepper.steps[change].scene["D_met"]
    assert last[-2] >= 0 > last[-1]
    with pytest.raises(ValueError, match="outside"):
        raycast_stepper(volume, frame.camera, frame.T_WC, (48, 0))


@pytest.mark.parametrize("contrast", ["released", "std"])
def test_quadtree_ends_with_the_leaves_of_the_operation(frame, press, contrast):
    rgb_u8 = (255 * frame.rgb).to(torch.uint8)
    settings = {
        "threshold": 0.02 if contrast == "released" else 0.06,
        "min_cell_px": 4,
        "contrast": contrast,
    }
    stepper = quadtree_stepper(rgb_u8, **settings)
    press(stepper)
    with use_backend("reference"):
        cells = quadtree(rgb_u8, **settings)
    expected = list(
        zip(
            *(getattr(cells, k).tolist() for k in ("x0", "y0", "width", "height")),
            strict=True,
        )
    )
    assert list(stepper.steps[-1].scene["leaves"]) == expected
    looked = [step for step in stepper.steps if step.title.endswith("above the threshold.")]
    for step in looked:
        numbers = {row[0]: row[1] for row in step.numbers}
        above = float(numbers["contrast"]) > float(numbers["threshold"])
        assert above == (numbers["split"] == "yes")
    assert len(looked) > 3
