"""Every kernel compiles to machine code, in the variants that the operations launch: the
interpreter takes more than the compiler does, which needs no GPU."""

import importlib
import inspect
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from gsfusion_nb.backends import use_backend
from gsfusion_nb.config import TsdfConfig
from gsfusion_nb.geometry import depth_to_normals
from gsfusion_nb.optim import dssim_vjp
from gsfusion_nb.optim.depth_loss import expected_depth_loss
from gsfusion_nb.optim.rgbd_loss import rgbd_l1_vjp
from gsfusion_nb.render import disc_depth, disc_depth_vjp, render_forward
from gsfusion_nb.tracking import DepthLevel, Surface, icp_system
from gsfusion_nb.tsdf import TsdfVolume, integrate, raycast

pytestmark = pytest.mark.skipif(
    torch.cuda.is_available(), reason="on a GPU the other tests compile the kernels"
)

SCRIPT = Path(__file__).with_name("compile_recorded.py")
TYPES = {
    torch.float32: "*fp32",
    torch.float64: "*fp64",
    torch.uint8: "*u8",
    torch.int16: "*i16",
    torch.int32: "*i32",
    torch.int64: "*i64",
}


@pytest.fixture
def launches(monkeypatch):
    """What is launched, each kernel and variant once."""
    from triton.runtime.interpreter import InterpretedFunction

    real = InterpretedFunction.__getitem__
    seen = {}

    def record(function, arguments):
        parameters = [*inspect.signature(function).parameters.values()]
        fixed = {p.name for p in parameters if "constexpr" in str(p.annotation)}
        types = {}
        for name in (p.name for p in parameters if p.name not in fixed):
            value = arguments[name]
            scalar = "i32" if isinstance(value, int) else "fp32"
            types[name] = TYPES[value.dtype] if isinstance(value, torch.Tensor) else scalar
        launch = {
            "module": function.__module__,
            "kernel": function.__name__,
            "types": types,
            "constants": {name: value for name, value in arguments.items() if name in fixed},
            "num_warps": arguments["num_warps"],
        }
        seen[json.dumps(launch)] = launch

    def getitem(self, grid):
        run = real(self, grid)

        def call(**arguments):
            record(self.fn, arguments)
            return run(**arguments)

        return call

    monkeypatch.setattr(InterpretedFunction, "__getitem__", getitem)
    return seen


def run_everything(scene, camera, images, pose, frame) -> None:
    """Each operation with all its options."""
    pixels = torch.ones(camera.height, camera.width, dtype=torch.bool)
    rows = torch.ones(len(scene), dtype=torch.bool)
    volume = TsdfVolume(TsdfConfig(voxel_size_m=0.1, truncation_voxels=2.0))
    with use_backend("reference"):
        out, _ = render_forward(scene, camera, pose, opaque_alpha=0.5)
        integrate(volume, frame)
        seen = raycast(volume, frame.camera, frame.T_WC)
    with use_backend("triton"):
        disc_depth(scene, camera, pose, out.hit_index)
        disc_depth_vjp(scene, camera, pose, out.hit_index, images[1], rows=rows)
        dssim_vjp(images[0], out.rgb)
        expected_depth_loss(out.depth_m, out.alpha, images[1], 0.1)
        rgbd_l1_vjp(out.rgb, out.depth_m, images[0], images[1], pixels)
        normal = depth_to_normals(frame.camera, frame.depth_m)
        level = DepthLevel(factor=1, camera=frame.camera, depth_m=frame.depth_m, normal_C=normal)
        surface = Surface(
            depth_m=seen.depth_m, normal_W=seen.normal_W, camera=frame.camera, T_WC=frame.T_WC
        )
        icp_system(level, frame.T_WC.double(), surface, max_distance_m=0.1, min_cosine=0.5)


@pytest.mark.parametrize("capability", [90, pytest.param(80, marks=pytest.mark.slow)])
def test_every_kernel_compiles(
    capability, launches, make_scene, make_camera, make_images, make_frames, pose, tmp_path
):
    camera = make_camera(16, 8)
    frame = make_frames(12, 9, n=1)[0]
    run_everything(make_scene(5, 3), camera, make_images(camera), pose, frame)
    kernels = Path(importlib.import_module("gsfusion_nb.kernels").__file__ or "").parent
    sources = "".join(path.read_text(encoding="utf-8") for path in kernels.glob("*/triton.py"))
    declared = set(re.findall(r"@triton\.jit\(\s*do_not_specialize[^)]*\)\ndef (\w+)", sources))
    assert {launch["kernel"] for launch in launches.values()} == declared
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    environment["TRITON_CACHE_DIR"] = str(tmp_path)
    done = subprocess.run(
        [sys.executable, str(SCRIPT), str(capability)],
        input=json.dumps([*launches.values()]),
        capture_output=True,
        text=True,
        env=environment,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert f"compiled {len(launches)}" in done.stdout
    spilled = [
        line
        for line in done.stdout.splitlines()
        if int(re.findall(r"STACK:(\d+)|$", line)[0] or 0) > 32
    ]
    assert not spilled, f"kernels that spill registers: {spilled}"
