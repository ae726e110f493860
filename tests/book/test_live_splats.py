"""What the splatting panels of the book compute, run by node, against the library: ellipses,
pictures, gradients, Adam, seeds."""

import json
import subprocess
from dataclasses import asdict
from pathlib import Path

import pytest
import torch

from gsfusion_nb.data.room import RoomSequence
from gsfusion_nb.geometry import se3
from gsfusion_nb.geometry.spherical_harmonics import sh_to_rgb
from gsfusion_nb.optim import adam_update, l1_mse_vjp
from gsfusion_nb.render import composite, project_gaussians, render_forward, render_vjp
from gsfusion_nb.render.tiles import tile_intersections
from gsfusion_nb.seeding import quadtree
from gsfusion_nb.seeding.quadtree import cell_gaussians, cut_to_size
from gsfusion_nb.types import Camera, GaussianParams

LIVE = Path(__file__).resolve().parents[2] / "tools/book/live"
SOURCES = "".join((LIVE / f"{name}.js").read_text() for name in ("formulas", "splats", "gradients"))
CAMERA = Camera(width=45, height=37, fx=40.0, fy=42.0, cx=21.0, cy=19.5)
COLUMNS = ("xyz_W", "log_scale", "quat", "opacity_logit", "sh")
RATES = (2e-3, 1e-2, 1e-2, 5e-2, 2e-2)

PRELUDE = """
const list = (x) => (ArrayBuffer.isView(x) ? [...x] : x);
const show = (x) => console.log(JSON.stringify(x, (_, value) => list(value)));
const columns = (map) => Object.keys(COLUMNS).map((name) => [...map[name]]);
const asMap = (values) => {
  const map = emptyMap(values[3].length);
  Object.keys(COLUMNS).forEach((name, k) => map[name].set(values[k]));
  return map;
};
"""


def computed(node: str, script: str, **values):
    """What a script shows that knows the panels' functions and these values."""
    given = "".join(f"const {name} = {json.dumps(value)};\n" for name, value in values.items())
    program = f"{SOURCES}{PRELUDE}{given}{script}"
    process = subprocess.run([node, "-"], input=program, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr[-2000:]
    return json.loads(process.stdout)


def close(got, expected: torch.Tensor, *, rtol: float = 1e-9, atol: float = 1e-11) -> None:
    got = torch.tensor(got, dtype=torch.float64).reshape(expected.shape)
    torch.testing.assert_close(got, expected, rtol=rtol, atol=atol)


@pytest.fixture(scope="module")
def T_WC() -> torch.Tensor:
    twist = torch.tensor([0.1, -0.2, 0.3, 0.2, -0.1, 0.15], dtype=torch.float64)
    return se3.exp(twist)


@pytest.fixture(scope="module")
def params(T_WC) -> GaussianParams:
    """Sixty Gaussians: opaque and faint ones, a needle, some behind the camera, some beside the
    picture, where the projection is clamped."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    place = draw(60, 3) * torch.tensor([0.7, 0.6, 0.8], dtype=torch.float64)
    place[:, 2] += 1.6
    place[:3, 2] = -0.5
    place[3:6, 0] = 3.0
    log_scale = draw(60, 3) * 0.6 - 2.3
    log_scale[6] = torch.tensor([-1.0, -7.0, -7.0])
    opacity_logit = 3 * draw(60)
    opacity_logit[7:10] = 9.0
    return GaussianParams(
        xyz_W=se3.apply(T_WC, place),
        log_scale=log_scale,
        quat=draw(60, 4),
        opacity_logit=opacity_logit,
        sh=1.5 * draw(60, 1, 3),
    )


def given(params: GaussianParams, T_WC: torch.Tensor) -> dict:
    values = [getattr(params, name).flatten().tolist() for name in COLUMNS]
    return {"values": values, "camera": asdict(CAMERA), "T_WC": T_WC[:3].tolist()}


def test_the_ellipses_are_the_librarys(node, params, T_WC):
    expected = project_gaussians(params, CAMERA, T_WC)
    got = computed(
        node, "show(projectGaussians(asMap(values), camera, viewOf(T_WC)));", **given(params, T_WC)
    )
    visible = expected.visible
    assert 10 < int(visible.sum()) < 60
    assert got["visible"] == visible.int().tolist()
    for name in ("uv", "conic", "depth_m", "opacity", "extent_px"):
        reference = getattr(expected, name)
        values = torch.tensor(got[name], dtype=torch.float64).reshape(reference.shape)
        close(values[visible].tolist(), reference[visible])
    close(got["rgb"], sh_to_rgb(params.sh, params.xyz_W, T_WC[:3, 3]))


def test_the_picture_and_the_stack_of_a_pixel_are_the_librarys(node, params, T_WC):
    projection = project_gaussians(params, CAMERA, T_WC)
    tiles = tile_intersections.reference(projection, CAMERA)
    rgb = sh_to_rgb(params.sh, params.xyz_W, T_WC[:3, 3])
    expected = composite.reference(
        projection.uv, projection.conic, projection.opacity, rgb, projection.depth_m, tiles, CAMERA
    )
    script = """
        const { splats, rgb } = renderMap(asMap(values), camera, viewOf(T_WC));
        const stack = stackAt(splats, nearestFirst(splats), 20.5, 18.5);
        const total = (value) => stack.reduce((sum, entry) => sum + entry.w * value(entry), 0);
        const sum = [0, 1, 2].map((c) => total(({ row }) => splats.rgb[3 * row + c]));
        show({ rgb, sum, alpha: total(() => 1), nearest: stack[0].row, stack });
    """
    got = computed(node, script, **given(params, T_WC))
    close(got["rgb"], expected.rgb)
    close(got["sum"], expected.rgb[18, 20])
    assert got["alpha"] == pytest.approx(float(expected.alpha[18, 20]), rel=1e-9)
    assert got["nearest"] == int(expected.first_index[18, 20])
    assert len(got["stack"]) > 3
    dominant = max(got["stack"], key=lambda entry: entry["w"])
    assert dominant["row"] == int(expected.dominant_index[18, 20])


def test_the_loss_and_every_gradient_are_the_librarys(node, params, T_WC):
    generator = torch.Generator().manual_seed(1)
    target = torch.rand(CAMERA.height, CAMERA.width, 3, generator=generator, dtype=torch.float64)
    image, saved = render_forward.reference(params, CAMERA, T_WC)
    loss = l1_mse_vjp.reference(image.rgb, target)
    expected = render_vjp.reference(saved, loss.v_rgb)
    script = """
        const map = asMap(values), view = viewOf(T_WC), drawn = renderMap(map, camera, view);
        const { value, v_rgb, psnr } = pictureLoss(drawn.rgb, target);
        show({ value, psnr, columns: columns(renderMapVjp(map, camera, view, drawn, v_rgb).map) });
    """
    got = computed(node, script, target=target.flatten().tolist(), **given(params, T_WC))
    assert got["value"] == pytest.approx(float(loss.value), rel=1e-9)
    assert got["psnr"] == pytest.approx(-10 * float(loss.mse.log10()), rel=1e-9)
    for name, column in zip(COLUMNS, got["columns"], strict=True):
        reference = getattr(expected, name)
        assert float(reference.abs().max()) > 0
        close(column, reference, rtol=1e-7, atol=1e-12)


def test_three_steps_of_adam_are_the_librarys(node):
    generator = torch.Generator().manual_seed(2)
    param = torch.randn(7, generator=generator, dtype=torch.float64)
    gradients = torch.randn(3, 7, generator=generator, dtype=torch.float64)
    start = param.tolist()
    m = torch.zeros_like(param)
    v = torch.zeros_like(param)
    for t in range(3):
        adam_update.reference(
            param, gradients[t], m, v, t + 1, lr=0.02, beta1=0.9, beta2=0.999, eps=1e-15
        )
    script = """
        const [param, m, v] = [start, start.map(() => 0), start.map(() => 0)];
        gradients.forEach((g, k) => adamUpdate(param, g, m, v, k + 1, 0.02));
        show([param, m, v]);
    """
    got = computed(node, script, start=start, gradients=gradients.tolist())
    close(got, torch.stack([param, m, v]))


@pytest.mark.parametrize(("largest_m", "min_cell_px"), [(0.05, 1), (0.2, 3)])
def test_the_seeds_of_a_frame_are_the_librarys(node, largest_m, min_cell_px):
    frame = RoomSequence(n_frames=60, width=107, height=75)[0]
    depth_m = frame.depth_m.double()
    cells = quadtree(frame.rgb_u8, threshold=0.05, contrast="std", min_cell_px=min_cell_px)
    cells = cut_to_size(cells, frame.camera, depth_m, largest_m, min_cell_px=min_cell_px)
    xyz, scale = cell_gaussians(frame.camera, cells, depth_m, torch.eye(4, dtype=torch.float64))
    expected = torch.cat(
        [
            torch.stack([cells.x0, cells.y0, cells.width, cells.height, cells.level], dim=1),
            xyz,
            scale[:, None],
        ],
        dim=1,
    )
    script = """
        const leaves = quadtree(rgb, 107, 75, { threshold: 0.05, min, contrast: "std" });
        const cells = cutToSize(leaves, camera, depth, largest, min);
        const seeds = cells.map(({ cell }) => seedOf(cell, camera, depth));
        show(cells.map(({ cell, level }, k) => [...cell, level, ...seeds[k].xyz, seeds[k].scale]));
    """
    got = computed(
        node,
        script,
        rgb=frame.rgb_u8.flatten().tolist(),
        camera=asdict(frame.camera),
        depth=depth_m.flatten().tolist(),
        largest=largest_m,
        min=min_cell_px,
    )
    assert len(got) > 50
    expected = torch.tensor(sorted(expected.tolist()), dtype=torch.float64)
    close(sorted(got), expected, rtol=2e-7)  # the library's half diagonal of a cell is float32
