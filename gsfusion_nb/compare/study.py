"""Running a study: every variant is a separate run in its own process; then one table with the results."""

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from ..backends import from_environment
from ..checks import check_name
from ..data import open_sequence, sequence_fingerprint
from ..evaluation import format_metric
from ..export import CheckpointStore
from ..foreign import read_object
from ..runs.run_folder import CHECKPOINTS, METRICS, is_complete
from . import disc_depth, roofline
from .grid import parse_axis
from .rate import draw_rates
from .spec import arguments_with_files, run_key
from .variants import RATE, STUDIES

COLUMNS = {
    "psnr_mapped_online_db": "PSNR mapped, online",
    "psnr_held_out_online_db": "PSNR held out, online",
    "ssim_held_out_online": "SSIM held out, online",
    "psnr_mapped_db": "PSNR mapped",
    "psnr_held_out_db": "PSNR held out",
    "ssim_held_out": "SSIM held out",
    "depth_l1_held_out_m": "depth error",
    "n_gaussians": "Gaussians",
    "n_keyframes": "keyframes",
    "ate_rmse_m": "ATE RMSE",
    "drift_m": "drift",
    "fps_total": "frames/s",
    "fps_mapping": "mapping, frames/s",
    "fps_tracking": "tracking, frames/s",
    "mesh_psnr_held_out_db": "mesh, PSNR held out",
    "mesh_accuracy_m": "accuracy",
    "mesh_completion_m": "completion",
    "mesh_completion_ratio": "completion < 3 cm",
    "peak_memory_mb": "memory",
}
"""Name in metrics.json -> heading."""


@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """Run one of the papers' comparisons on a sequence and print a table.

    Each variant is a run with all its files in OUT, in a folder whose name ends in a key of the data, the options and
    the program. A variant that is already complete in its folder is not repeated; the output says so.
    """

    name: Annotated[str, tyro.conf.Positional]
    """What to compare: systems (all three), transparent (with and without transparent Gaussians), states (optimising
    unstable or all Gaussians), fidelity (as measured, paper or released code), gsfusion-settings and rtg-slam-settings
    (one changed setting at a time), depth (disc or blended depth), tracking (variants of the tracker), rate (GPS-SLAM's
    frames per second against its PSNR, with a picture), colours (weights of the TSDF's colours, without Gaussians),
    disc-depth (depth of single images), or roofline (kernels and the limits of this machine)."""
    data: Annotated[str, tyro.conf.Positional] = "room"
    """Folder of a sequence, or "room" for the built-in scene."""
    out: str = ""
    """Folder for the runs. Default: runs/study-<name>."""
    options: str = ""
    """Options of gsfusion-nb map that are used for every variant, in quotes and after an equals sign:
    --options="--data.width 320 --data.height 240"."""
    only: str = ""
    """Only the variants whose name contains this text, in capital or small letters: --only given. Default: all."""
    views: int = 20
    """Only for disc-depth: number of views to fit."""
    device: str = "cpu"
    """Only for roofline: the device to measure, cpu or cuda."""
    cache: bool = True
    """Use variants that are complete in OUT from before. --no-cache runs all again, in new folders."""


def main(options: StudyOptions) -> int:
    """Run, print and save. Returns the exit status."""
    check_name("study", options.name, ("disc-depth", "roofline", *STUDIES))
    folder = Path(options.out or f"runs/study-{options.name}").expanduser()
    folder.mkdir(parents=True, exist_ok=True)
    if options.name == "disc-depth":
        return disc_depth.main(options.data, folder, options.views)
    if options.name == "roofline":
        return roofline.main(options.device, folder)
    study = STUDIES[options.name]
    variants = {label: v for label, v in study.variants.items() if options.only.lower() in label.lower()}
    if not variants:
        raise ValueError(f"--only: no variant's name contains {options.only!r}; there are {', '.join(study.variants)}")
    print(f"{study.question}, on {options.data}")
    results = {}
    for label, variant in variants.items():
        arguments = [*variant, *options.options.split()]
        place = folder / f"{_slug(label)}-{variant_key(options.data, arguments)[:12]}"
        place = place if options.cache else _free(place)
        done = f"reused from {place}" if is_complete(place) else "done"
        results[label] = run_variant(options.data, place, arguments)
        print(f"  {label}: {results[label].get('error', done)}", flush=True)
    text = as_markdown(results)
    (folder / "table.md").write_text(f"{study.question}, on {Path(options.data).name}\n\n{text}\n", encoding="utf-8")
    (folder / "table.json").write_text(json.dumps(results, indent=1), encoding="utf-8")
    if options.name == RATE:
        draw_rates(results, folder / "rate.png")
    print(f"\n{text}\n\nFiles in {folder}")
    return 1 if any("error" in r for r in results.values()) else 0


def variant_key(data: str, arguments: list[str]) -> str:
    """Key of a run of ``gsfusion-nb map``, made from the content of every file of its data, its arguments, the backend
    and the program."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)  # of what decides which files are read
    parser.add_argument("--format", default="auto")
    parser.add_argument("--split")
    parser.add_argument("--reader", nargs="*", default=[])
    given, _ = parser.parse_known_args(arguments)
    try:
        reader = {name: values[0] for name, values in map(parse_axis, given.reader)}
        content = sequence_fingerprint(open_sequence(data, format=given.format, split=given.split, **reader))
    except (KeyError, TypeError, ValueError, OSError) as e:  # the run fails with it and says so
        content = f"{type(e).__name__}: {e}"
    return run_key(data=content, arguments=arguments_with_files(arguments), backend=from_environment())


def run_variant(data: str, folder: Path, arguments: list[str]) -> dict[str, Any]:
    """Metrics of one run, which is started unless it is complete in ``folder``; ``{"error": message}`` if it failed.

    ``folder`` must belong to this variant only: see ``variant_key``.
    """
    if not is_complete(folder):
        command = [sys.executable, "-m", "gsfusion_nb", "map", data, "--out", str(folder), *arguments]
        if CheckpointStore(folder / CHECKPOINTS).exists:
            command = [sys.executable, "-m", "gsfusion_nb", "map", "--resume", str(folder)]
        done = subprocess.run(command, capture_output=True, text=True)
        if not is_complete(folder):
            lines = (done.stderr or done.stdout).strip().splitlines()
            return {"error": lines[-1] if lines else f"ended with status {done.returncode}"}
    return read_object(folder / METRICS, "the numbers of a run", objects=("metrics",))["metrics"]


def as_markdown(results: dict[str, dict[str, Any]]) -> str:
    """A table with a row per variant; columns without values are left out."""
    shown = [name for name in COLUMNS if any(name in metrics for metrics in results.values())]
    lines = [f"| | {' | '.join(COLUMNS[name] for name in shown)} |", f"|---|{'---:|' * len(shown)}"]
    for label, metrics in results.items():
        cells = [format_metric(name, metrics[name]) if name in metrics else "-" for name in shown]
        lines.append(f"| {label} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _free(place: Path) -> Path:
    """A folder that does not exist yet, named after ``place``."""
    n = 1
    while (free := place if n == 1 else place.with_name(f"{place.name}-{n}")).exists():
        n += 1
    return free


def _slug(label: str) -> str:
    return "-".join("".join(c if c.isalnum() else " " for c in label.lower()).split())
