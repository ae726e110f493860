"""Smaller files made by splat-transform from our PLY: read back, drawn, and compared with the picture before.

``GSNB_RUN=runs/room-... pytest -m slow -s tests/browser/test_small_files.py`` prints sizes and PSNR for the map of a
run, on its held-out views.
"""

import math
import os
from pathlib import Path

import npm_programs
import pytest
from small_map import small_map

from gsfusion_nb.config import GSFusionConfig, from_dict
from gsfusion_nb.data import open_sequence
from gsfusion_nb.export import read_gaussians, write_gaussian_ply, write_map_glb
from gsfusion_nb.files import read_json
from gsfusion_nb.render import render
from gsfusion_nb.types import Camera, GaussianParams

pytestmark = pytest.mark.slow
KINDS = {
    "SPZ 3": ("small.spz", ["--spz-version", "3"]), "SPZ 4": ("small4.spz", ["--spz-version", "4"]),
    "SOG": ("small.sog", []), "compressed PLY": ("small.compressed.ply", []),
    "SPZ, degree 0": ("flat.spz", ["-H", "0", "--spz-version", "3"]),
}  # fmt: skip
LEAST_DB = 40.0
"""Between the pictures before and after; of the small test map."""


def views() -> list:
    """Held-out frames of the run, each with its pose; none without a run."""
    if "GSNB_RUN" not in os.environ:
        return []
    config = read_json(Path(os.environ["GSNB_RUN"]) / "config.json", "settings")
    source, settings = dict(config["source"]), from_dict(GSFusionConfig, config["config"])
    return list(open_sequence(source.pop("path_or_name"), **source, data=settings.data).held_out)


def psnr_db(mse: float) -> float:
    return -10 * math.log10(max(mse, 1e-12))


def pictures(gaussians: GaussianParams, frames: list) -> list:
    if frames:
        return [render(gaussians, f.camera, f.T_WC).rgb.clamp(0, 1) for f in frames]
    import torch

    camera = Camera(width=160, height=120, fx=120.0, fy=120.0, cx=80.0, cy=60.0)
    T_WC = torch.eye(4)
    T_WC[2, 3] = -2.0
    return [render(gaussians, camera, T_WC).rgb.clamp(0, 1)]


def test_smaller_files_look_nearly_the_same(tmp_path):
    npm_programs.npm_folder("@playcanvas/splat-transform")
    source = tmp_path / "gaussians.ply"
    frames = views()
    gaussians = read_gaussians(Path(os.environ["GSNB_RUN"]) / "gaussians.ply") if frames else small_map()
    write_gaussian_ply(source, gaussians)
    write_map_glb(tmp_path / "map.glb", gaussians)
    before = pictures(gaussians, frames)
    n = len(before)
    lines = [f"{'PLY':16} {source.stat().st_size / 1e6:7.2f} MB"]
    lines += [f"{'glTF':16} {(tmp_path / 'map.glb').stat().st_size / 1e6:7.2f} MB"]
    if frames:
        score = sum(psnr_db(float(((p - f.rgb) ** 2).mean())) for p, f in zip(before, frames, strict=True)) / n
        lines[0] += f"  held-out {score:.2f} dB"
    for kind, (name, options) in KINDS.items():
        more = [*options[:2]] if options[:1] == ["-H"] else []
        npm_programs.splat_transform(source, *more, *options[len(more) :], tmp_path / name)
        after = pictures(read_gaussians(tmp_path / name), frames)
        same = sum(psnr_db(float(((a - b) ** 2).mean())) for a, b in zip(before, after, strict=True)) / n
        line = f"{kind:16} {(tmp_path / name).stat().st_size / 1e6:7.2f} MB  {same:.1f} dB against the picture before"
        if frames:
            score = sum(psnr_db(float(((p - f.rgb) ** 2).mean())) for p, f in zip(after, frames, strict=True)) / n
            line += f", held-out {score:.2f} dB"
        lines.append(line)
        assert frames or same > LEAST_DB, line
    print("", *lines, sep="\n")  # noqa: T201
