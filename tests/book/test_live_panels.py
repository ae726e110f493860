"""What pages of the book compute by themselves, run by node, against the library: points, fused
distances, cells."""

import json
import re
import subprocess
from dataclasses import asdict
from pathlib import Path

import pytest
import torch
from book.live_data import packed_maps
from book.live_panels import PANELS, POSTERS, common_script, panel_html, panel_script

from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.data.room import RoomSequence
from gsfusion_nb.geometry import backproject, project, se3
from gsfusion_nb.seeding import quadtree
from gsfusion_nb.tsdf.volume import TsdfSample
from gsfusion_nb.tsdf.voxel_update import fuse_voxels
from gsfusion_nb.types import GaussianParams

LIVE = Path(__file__).resolve().parents[2] / "tools/book/live"
FORMULAS = LIVE / "formulas.js"
SHARED = "".join(
    (LIVE / f"{name}.js").read_text(encoding="utf-8") for name in ("splats", "maps", "panel")
)


def computed(node: str, expression: str, **values):
    """What an expression is in a page that knows these values."""
    given = "".join(f"const {name} = {json.dumps(value)};\n" for name, value in values.items())
    script = f"{FORMULAS.read_text()}{given}console.log(JSON.stringify({expression}));"
    return json.loads(
        subprocess.run(
            [node, "-"],
            input=script,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    )


@pytest.mark.parametrize(("truncation_voxels", "most"), [(1.0, 16.0), (4.0, 3.0)])
def test_samples_of_rays_have_the_librarys_place_and_distance(node, truncation_voxels, most):
    walk = RoomSequence(n_frames=240, width=80, height=60, noise="kinect")
    frames = [walk[i] for i in range(6)]
    camera = walk.camera
    config = TsdfConfig(
        voxel_size_m=0.04, truncation_voxels=truncation_voxels, max_weight=most, sdf="z"
    )
    uv = torch.tensor(
        [[20.5, 31.5], [61.5, 10.5], [3.5, 55.5]],
        dtype=torch.float64,
    ).repeat_interleave(95, 0)
    z = torch.arange(95, dtype=torch.float64).repeat(3) * 0.04 + 0.42
    xyz_W = se3.apply(frames[0].T_WC.double(), backproject(camera, uv, z))
    after = TsdfSample(
        D=torch.ones(285),
        W=torch.zeros(285),
        rgb=torch.zeros(285, 3),
        W_rgb=torch.zeros(285),
    )
    for frame in frames:
        xyz_C = se3.apply(se3.inverse(frame.T_WC.double()), xyz_W)
        after, _ = fuse_voxels(after, xyz_C, frame, config)
    expected = torch.cat(
        [xyz_W, project(camera, xyz_C), after.D[:, None], after.W[:, None]],
        dim=1,
    )

    each = "const xyz = apply(frames[0][0], backproject(camera, u, v, z[i]));"
    said = "frames.map(([T, depth]) => signedDistance(camera, depth, T, xyz))"
    place = "...project(camera, applyInverse(frames.at(-1)[0], xyz))"
    got = computed(
        node,
        f"uv.map(([u, v], i) => {{ {each} return [...xyz, {place}, ...fused({said}, eps, most)]; "
        f"}})",
        uv=uv.tolist(),
        z=z.tolist(),
        camera=asdict(camera),
        eps=config.truncation_m,
        most=most,
        frames=[[f.T_WC[:3].tolist(), f.depth_m.flatten().tolist()] for f in frames],
    )
    torch.testing.assert_close(
        torch.tensor(got, dtype=torch.float64), expected, atol=1e-5, rtol=1e-5
    )
    assert computed(
        node, "zeroCrossing([[1, 1], [0.2, 0], [0.2, 2], [-0.6, 1]], 1, 0.04)"
    ) == pytest.approx(1.09)


@pytest.mark.parametrize(
    ("threshold", "least", "contrast"),
    [(0.02, 1, "released"), (0.05, 3, "std")],
)
def test_the_cells_are_the_librarys(node, threshold, least, contrast):
    rgb = RoomSequence(n_frames=60, width=107, height=75)[0].rgb_u8
    cells = quadtree(rgb, threshold=threshold, min_cell_px=least, contrast=contrast)
    given = {"threshold": threshold, "min": least, "contrast": contrast}
    leaves = "quadtree(rgb, 107, 75, settings).map(({ cell, level }) => [...cell, level])"
    got = computed(node, leaves, rgb=rgb.flatten().tolist(), settings=given)
    assert (
        got
        == torch.stack(
            [cells.x0, cells.y0, cells.width, cells.height, cells.level],
            dim=1,
        ).tolist()
    )


MAPPED = [pytest.param(name, marks=pytest.mark.ci) for name in ("stack", "room")]
"""Panels for which a map is made, which takes ten seconds."""


@pytest.mark.parametrize("name", [*sorted({*PANELS.values()} - {"stack", "room"}), *MAPPED])
def test_the_panels_are_small(name):
    """On a slow phone of 200 kB/s each comes within two seconds, what they share within a fifth."""
    assert len(common_script()) < 40_000
    assert len(panel_script(name)) < 400_000


def test_a_stored_map_is_read_as_it_was_packed(node):
    generator = torch.Generator().manual_seed(0)

    def draw(n: int) -> GaussianParams:
        shapes = {"xyz_W": (n, 3), "log_scale": (n, 3), "quat": (n, 4), "sh": (n, 1, 3)}
        columns = {k: torch.rand(*shape, generator=generator) for k, shape in shapes.items()}
        return GaussianParams(opacity_logit=torch.rand(n, generator=generator), **columns)

    maps = [draw(n) for n in (3, 3, 7)]
    stored = packed_maps(maps)
    script = (
        f"{SHARED}storedMaps({json.dumps(stored)}).then((maps) => "
        "console.log(JSON.stringify(maps.map((map) => "
        "Object.keys(COLUMNS).map((name) => [...map[name]])))));"
    )
    process = subprocess.run([node, "-"], input=script, capture_output=True, text=True, check=True)
    for params, columns in zip(maps, json.loads(process.stdout), strict=True):
        quat = torch.nn.functional.normalize(params.quat, dim=1)
        values = (params.xyz_W, params.log_scale, quat, params.opacity_logit, params.sh)
        steps = (8191, 127, 127, 127, 127)
        spans = [high - low for low, high in stored["ranges"].values()]
        for value, column, n_steps, span in zip(values, columns, steps, spans, strict=True):
            got = torch.tensor(column).reshape(value.shape)
            assert float((got - value).abs().max()) <= 0.501 * span / n_steps


def test_a_panel_says_everything_without_its_script():
    for name in PANELS.values():
        html = panel_html(name)
        assert "{{" not in html
        # every picture has a poster, which is there, and words
        for file, words in re.findall(r'_static/posters/([\w.]+)" [^>]*alt="([^"]+)"', html):
            assert (POSTERS / file).exists()
            assert len(words) > 10
        charts = re.findall(r'data-chart="\w+"[^>]*>(.)', html)
        assert charts == ["<"] * len(charts)
        # what does nothing without the script cannot be used
        assert len(re.findall(r"<(?:input|select|button)[^>]* disabled", html)) == len(
            re.findall(r"<(?:input|select|button)", html)
        )
        assert '<p role="status">' in html
