"""The front end's mathematics, run by node, against the library's own: the same ellipses, the same
picture."""

import json
import subprocess

import numpy as np
import pytest
import torch

from gsfusion_nb.geometry.spherical_harmonics import sh_to_rgb
from gsfusion_nb.render import project_gaussians, render
from gsfusion_nb.types import Camera, GaussianParams
from gsfusion_nb.viewer.front_end import ENGINE, viewer_modules
from gsfusion_nb.viewer.splat_rows import layout_for, pack_rows, packet_between
from gsfusion_nb.viewer.splat_state import rules
from gsfusion_nb.viz import orbit_camera
from gsfusion_nb.viz.splat_viewer import SplatViewer

CAMERA = Camera(
    width=90,
    height=67,
    fx=70.0,
    fy=72.0,
    cx=44.0,
    cy=35.0,
)
T_WC = orbit_camera((0.1, -0.2, 0.3), 30, 20, 3.0)
LOOK = {
    "size": 1,
    "opacity": 1,
    "points": False,
    "bornUntil": None,
    "birth": -1,
    "limit": 1e9,
    "picked": None,
    "paint": {"by": "rgb"},
    "background": [0, 0, 0],
}

_SCRIPT = """
import { readFileSync } from "node:fs";
const input = JSON.parse(readFileSync(process.argv[2] + "/input.json"));
const engine = new Engine();
const load = (name) => Uint8Array.from(readFileSync(process.argv[2] + "/" + name)).buffer;
for (const { head, index: rows, file } of input.packets) {
  engine.handle({ kind: "rows", head, index: rows && Int32Array.from(rows), bytes: load(file) });
}
const { pose, intrinsics, width, height, look, rules, scale } = input;
const view = viewOf(pose, intrinsics, width, height, scale);
const answers = input.ask.map((extra) => {
  const [reply] = engine.handle({ view, rules, ...extra, look: { ...look, ...extra.look } });
  const plain = ([k, v]) => [k, ArrayBuffer.isView(v) ? [...v] : v];
  return Object.fromEntries(Object.entries(reply).map(plain));
});
const p = project(engine.rows, view, look, rules);
const projected = {};
const columns = Object.keys(p).filter((k) => k !== "count");
for (const k of columns) projected[k] = [...p[k].subarray(0, p.count)];
console.log(JSON.stringify({ answers, projected, order: [...depthOrder(p)] }));
"""


@pytest.fixture
def ask(node, tmp_path):
    """``ask(params, *questions)`` lets the engine load a map and answer."""

    def run(params, *questions, columns=None, packets=None, scale=1.0, **look):
        columns = np.zeros((len(params), 0), np.float32) if columns is None else columns
        layout = layout_for(params, columns.shape[1])
        whole = [(None, pack_rows(params, columns, layout), len(params))]
        messages = []
        for k, (index, records, n) in enumerate(whole if packets is None else packets):
            (tmp_path / f"{k}.bin").write_bytes(records.tobytes())
            head = {
                "n": n,
                "stride": layout.stride,
                "columns": layout.columns,
                "harmonics": layout.harmonics,
                "all": index is None,
            }
            messages.append({"head": head, "index": index, "file": f"{k}.bin"})
        c = CAMERA
        data = {
            "packets": messages,
            "pose": T_WC.flatten().tolist(),
            "intrinsics": [c.fx, c.fy, c.cx, c.cy],
            "width": c.width,
            "height": c.height,
            "look": LOOK | look,
            "rules": rules(),
            "scale": scale,
            "ask": list(questions),
        }
        (tmp_path / "input.json").write_text(json.dumps(data))
        (tmp_path / "engine.mjs").write_text(viewer_modules(ENGINE) + _SCRIPT)
        done = subprocess.run(
            [node, tmp_path / "engine.mjs", tmp_path], capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run


@pytest.fixture
def scene(generator):
    """300 Gaussians around the middle, some behind the camera, on the grid that travels
    (float16)."""
    n = 300

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    params = GaussianParams(
        xyz_W=0.8 * normal(n, 3),
        log_scale=0.5 * normal(n, 3) - 2.5,
        quat=normal(n, 4),
        opacity_logit=2 * normal(n),
        sh=0.3 * normal(n, 16, 3),
    )
    params.xyz_W[:20] += 4 * T_WC[:3, 3]
    rounded = {k: getattr(params, k).half().float() for k in ("log_scale", "quat", "sh")}
    logit = params.opacity_logit.sigmoid().half().float().clamp(1e-4, 1 - 2**-11).logit()
    return GaussianParams(xyz_W=params.xyz_W, opacity_logit=logit, **rounded)


def pixels(answer):
    return np.array(answer["pixels"], np.uint8).reshape(answer["height"], answer["width"], 4)


def psnr(a, b):
    return 10 * np.log10(
        255**2
        / max(
            ((a.astype(float) - b.astype(float)) ** 2).mean(),
            1e-9,
        )
    )


def as_bytes(rgb):
    return (rgb.clamp(0, 1) * 255).numpy()


def test_the_module_is_valid(node, tmp_path):
    (tmp_path / "front_end.mjs").write_text(SplatViewer._esm)
    done = subprocess.run(
        [node, "--check", tmp_path / "front_end.mjs"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    for foreign in ("http://", "https://", "import(", "importScripts", "\nimport ", "fetch("):
        assert foreign not in SplatViewer._esm


def test_ellipses_are_those_of_the_renderer(ask, scene):
    ours = project_gaussians(scene, CAMERA, T_WC)
    theirs = {k: torch.tensor(v) for k, v in ask(scene)["projected"].items()}
    row = theirs["row"].long()
    assert 150 < len(row) < 300
    x, y = ours.uv.T
    ex, ey = ours.extent_px.T
    inside = (
        ours.visible
        & (x + ex > 0)
        & (x - ex < CAMERA.width)
        & (y + ey > 0)
        & (y - ey < CAMERA.height)
    )
    # on the border
    assert (torch.zeros(len(scene), dtype=torch.bool).index_fill(0, row, True) != inside).sum() <= 1
    for names, expected in (
        (("u", "v"), ours.uv),
        (("A", "B", "C"), ours.conic),
        (("depth",), ours.depth_m[:, None]),
        (("opacity",), ours.opacity[:, None]),
        (("halfWidth", "halfHeight"), ours.extent_px),
    ):
        got = torch.stack([theirs[n] for n in names], dim=1)
        # worst seen: 4e-4 of a conic
        torch.testing.assert_close(got, expected[row], rtol=2e-3, atol=1e-3)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_picture_is_the_renderers(ask, scene, degree):
    params = GaussianParams(
        xyz_W=scene.xyz_W,
        log_scale=scene.log_scale,
        quat=scene.quat,
        opacity_logit=scene.opacity_logit,
        sh=scene.sh[:, : (degree + 1) ** 2],
    )
    (answer,) = ask(params, {"kind": "draw"})["answers"]
    expected = render(params, CAMERA, T_WC)
    # 52 dB seen: bytes are rounded
    assert psnr(pixels(answer)[..., :3], as_bytes(expected.rgb)) > 45
    assert (answer["drawn"], answer["thinned"], answer["mark"]) == (
        len(ask(params)["projected"]["row"]),
        None,
        None,
    )


def test_settings_of_the_look(ask, scene):
    answer = ask(
        scene,
        {"kind": "draw", "look": {"background": [0.2, 0.4, 1]}},
        {"kind": "draw", "look": {"size": 1.5}},
        {"kind": "draw", "look": {"opacity": 0.5}},
        {"kind": "draw", "look": {"points": True}},
    )["answers"]
    view = render(scene, CAMERA, T_WC)
    behind = view.rgb + (1 - view.alpha[..., None]) * torch.tensor([0.2, 0.4, 1])
    assert psnr(pixels(answer[0])[..., :3], as_bytes(behind)) > 45
    scaled = GaussianParams(**{**vars(scene), "log_scale": scene.log_scale + np.log(1.5)})
    assert (
        psnr(
            pixels(answer[1])[..., :3],
            as_bytes(render(scaled, CAMERA, T_WC).rgb),
        )
        > 45
    )
    faint = GaussianParams(
        **{**vars(scene), "opacity_logit": (scene.opacity_logit.sigmoid() / 2).logit()}
    )
    assert (
        psnr(
            pixels(answer[2])[..., :3],
            as_bytes(render(faint, CAMERA, T_WC).rgb),
        )
        > 45
    )
    dark = (pixels(answer[3])[..., :3].max(-1) < 8).mean()
    assert 0.2 < dark < 0.95  # points leave gaps


def test_colours_by_number_and_by_depth(ask, scene):
    palette = "".join(f"{i:02x}0000" for i in range(256))
    column = np.linspace(0, 1, len(scene), dtype=np.float32)[:, None]
    paint = {"by": "column", "column": 0, "low": 0, "high": 1, "palette": palette}
    by_number, by_depth, order = ask(
        scene,
        {"kind": "draw", "look": {"paint": paint}},
        {"kind": "sort", "look": {"paint": {"by": "depth", "palette": palette}}},
        {"kind": "sort"},
        columns=column,
    )["answers"]
    assert pixels(by_number)[..., 0].max() > 100
    assert pixels(by_number)[..., 1].max() == 0
    red = np.array(by_depth["colours"]).reshape(-1, 4)[:, 0]
    assert (np.diff(red) <= 0).all()  # farthest first, far is the last colour
    assert 0 < by_depth["depthRange"][0] < by_depth["depthRange"][1]
    own = sh_to_rgb(scene.sh, scene.xyz_W, T_WC[:3, 3])[torch.tensor(order["order"])]
    assert np.abs(np.array(order["colours"]).reshape(-1, 4)[:, :3] - as_bytes(own)).max() <= 1.5


def test_a_pick_is_the_frontmost_that_covers_the_pixel_or_else_the_strongest(ask, scene):
    spots = [(20.5, 30.5), (45.5, 33.5), (60.5, 40.5), (33.5, 20.5), (50.5, 50.5)]
    answers = ask(
        scene,
        *[{"kind": "pick", "x": x, "y": y} for x, y in spots],
    )["answers"]
    p = project_gaussians(scene, CAMERA, T_WC)
    for (x, y), answer in zip(spots, answers, strict=True):
        dx, dy = torch.tensor([x, y]).sub(p.uv).T
        A, B, C = p.conic.T
        alpha = p.opacity * (-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy).exp() * p.visible
        covers = alpha >= rules()["pick_alpha"]
        expected = int(
            torch.where(covers, p.depth_m, torch.inf).argmin() if covers.any() else alpha.argmax()
        )
        assert answer["row"] == expected
        assert answer["depth"] == pytest.approx(float(p.depth_m[expected]), rel=1e-3)
    nothing = ask(scene[:0], {"kind": "pick", "x": 1, "y": 1})["answers"][0]
    assert nothing["row"] is None


def test_parts_add_up_to_the_map(ask, scene, generator):
    columns = np.zeros((len(scene), 0), np.float32)
    layout = layout_for(scene, 0)
    moved = GaussianParams(
        **{**vars(scene), "xyz_W": scene.xyz_W + 0.3 * (torch.arange(300) < 40)[:, None]}
    )
    first = pack_rows(scene[:200], columns[:200], layout)
    last = pack_rows(moved, columns, layout)
    packet = packet_between(first, last)
    assert packet is not None
    index, records = packet
    assert index is not None
    parts = [(None, first, 200), (index.tolist(), records, 300)]
    stepwise = ask(moved, {"kind": "draw"}, packets=parts)
    at_once = ask(moved, {"kind": "draw"})
    assert stepwise["projected"] == at_once["projected"]
    assert stepwise["answers"][0]["pixels"] == at_once["answers"][0]["pixels"]


def test_the_hand_moves_the_camera_like_orbit_camera(node, tmp_path):
    script = (
        viewer_modules(("camera",))
        + """
    const [pose, up] = JSON.parse(process.argv[2]);
    const round = new OrbitCamera(pose, 2.5, up);
    round.orbit(-Math.PI / 6, 0);
    const raised = new OrbitCamera(pose, 2.5, up);
    raised.orbit(0, Math.PI / 18);
    const near = new OrbitCamera(pose, 2.5, up);
    near.zoom(0.4);
    const aside = new OrbitCamera(pose, 2.5, up);
    aside.pan(50, 0, 100);
    const pole = new OrbitCamera(pose, 2.5, up);
    for (let k = 0; k < 100; k++) pole.orbit(0, 0.1);
    console.log(JSON.stringify([round, raised, near, aside, pole].map((c) => c.pose())));
    """
    )
    (tmp_path / "camera.mjs").write_text(script)
    target = (0.3, -0.2, 1.0)
    up = (0.0, 0.0, 1.0)
    start = orbit_camera(target, 40, 20, 2.5)
    data = json.dumps([start.flatten().tolist(), up])
    done = subprocess.run(
        [node, tmp_path / "camera.mjs", data], capture_output=True, text=True, check=True
    )
    turned, raised, near, aside, pole = (
        torch.tensor(p).view(4, 4) for p in json.loads(done.stdout)
    )
    close = {"rtol": 0, "atol": 1e-5}
    torch.testing.assert_close(turned, orbit_camera(target, 70, 20, 2.5), **close)
    torch.testing.assert_close(raised, orbit_camera(target, 40, 30, 2.5), **close)
    torch.testing.assert_close(near, orbit_camera(target, 40, 20, 1.0), **close)
    torch.testing.assert_close(
        aside[:3, 3],
        start[:3, 3] - 1.25 * start[:3, 0],
        **close,
    )  # 50 px at 2.5 m, focal 100
    assert -pole[2, 2] > 0.98  # nearly straight down, never over
    assert pole[2, 1] < 0  # still upright
