"""What a packed file costs: the size of a map in the kinds of files that splat-transform makes of
``gaussians.ply``, and the PSNR of held-out views of the map that is read back from it.

``GSNB_NPM=DIR python docs/measured/packed_files.py``. Node must be installed, and in the folder DIR
splat-transform: ``npm install --prefix DIR @playcanvas/splat-transform``.
"""

import json
import os
import subprocess
import tempfile
from pathlib import Path

from gsfusion_nb.config import gsfusion
from gsfusion_nb.data import open_sequence
from gsfusion_nb.evaluation import score_views
from gsfusion_nb.export import read_gaussian_ply
from gsfusion_nb.render import render
from gsfusion_nb.runs import run_mapping

PACKAGE = Path(os.environ["GSNB_NPM"]).resolve() / "node_modules/@playcanvas/splat-transform"
KINDS: dict[str, tuple[str, list[str]]] = {
    "compressed": ("map.compressed.ply", []),
    "sog": ("map.sog", ["-i", "3"]),
    "spz": ("map.spz", ["--spz-version", "3"]),
    "sog-H0": ("plain.sog", ["-H", "0"]),
}
"""Name of a row -> name of the packed file, and the options with which it is made."""


def transform(*arguments: str | Path) -> None:
    """Run splat-transform on the processor."""
    command = ["node", PACKAGE / "bin/cli.mjs", *arguments, "-w", "-g", "cpu"]
    subprocess.run([str(part) for part in command], check=True, stdout=subprocess.DEVNULL)


def psnr_db(path: Path) -> float:
    """Mean PSNR of the held-out views of the map in a PLY file."""
    params = read_gaussian_ply(path)
    scores = score_views(lambda camera, T_WC: render(params, camera, T_WC), sequence.held_out)
    return float(scores.psnr)


config = gsfusion("room")
sequence = open_sequence("room", data=config.data)

with tempfile.TemporaryDirectory() as folder:
    place = Path(folder)
    run = run_mapping("room", config, folder=place / "run", evaluate=False)
    original = place / "run/gaussians.ply"
    found = {"ply": {"megabytes": original.stat().st_size / 1e6, "psnr_db": psnr_db(original)}}
    found["ply"]["n_gaussians"] = run.metrics["n_gaussians"]
    for name, (file, options) in KINDS.items():
        packed, unpacked = place / file, place / f"{name}.ply"
        transform(original, *options, packed)
        transform(packed, unpacked)
        found[name] = {"megabytes": packed.stat().st_size / 1e6, "psnr_db": psnr_db(unpacked)}
version = json.loads((PACKAGE / "package.json").read_text(encoding="utf-8"))["version"]
rows = [{"label": name, "program": version} | row for name, row in found.items()]
print(json.dumps(rows))  # noqa: T201
