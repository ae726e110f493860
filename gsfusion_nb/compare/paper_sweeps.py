"""The comparisons that the papers print, as sweeps: which settings each varies, and the paper's own numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ..course.paper_tables import PAPER_TABLES, PaperComparison
from .spec import RunResult

Row = Mapping[str, float | int]


@dataclass(frozen=True, kw_only=True)
class PaperSweep:
    """A table or figure of a paper that can be repeated on any recording."""

    title: str
    """What it is, for the help."""
    rows: Mapping[str, Mapping[str, Any]]
    """The paper's name of a row -> settings and options (``rule.<name>``) of it."""
    number: str = ""
    """Number of the table in ``PAPER_TABLES``, if it has numbers."""
    views: str = "held_out"
    """Views that the paper scores: held_out or mapped."""
    system: str = "gsfusion"
    common: Mapping[str, Any] = field(default_factory=dict)
    """Settings of all rows."""
    paper: Mapping[str, Row] = field(default_factory=dict)
    """The paper's numbers by method, where they are not in ``PAPER_TABLES``."""
    about: str = ""
    """A sentence under the table."""


_GEOMETRY = ("Acc. cm", "Acc. ratio %", "Comp. cm", "Comp. ratio %")
PAPER_SWEEPS: dict[str, PaperSweep] = {
    "table-iv": PaperSweep(
        title="GSFusion, Table IV: voxel size", number="IV",
        rows={"1 cm": {"tsdf.voxel_size_m": 0.01}, "5 cm": {"tsdf.voxel_size_m": 0.05}},
    ),
    "table-v": PaperSweep(
        title="GSFusion, Table V: quadtree threshold", number="V",
        rows={"0.01": {"seeding.quadtree_threshold": 0.01}, "0.1": {"seeding.quadtree_threshold": 0.1}},
        about="The released contrast grows with the number of pixels: on small images a threshold gives fewer cells.",
    ),
    "table-vi": PaperSweep(
        title="GSFusion, Table VI: passes of the global optimisation", number="VI",
        rows={str(n): {"optim.global_iterations": n} for n in (0, 10, 20)},
    ),
    "table-vii": PaperSweep(
        title="GSFusion, Table VII: random keyframe optimisation", number="VII", views="mapped",
        common={"optim.global_iterations": 0},
        rows={
            "without": {"optim.frame_iterations": 5, "optim.random_keyframe_iterations": 0},
            "with": {"optim.frame_iterations": 3, "optim.random_keyframe_iterations": 2},
        },
        about="Both rows take 5 steps after each frame, as the equal speed in the paper implies.",
    ),
    "table-viii": PaperSweep(
        title="GSFusion, Table VIII: keyframe threshold", number="VIII", views="mapped",
        rows={str(n): {"keyframe_min_seeds": n} for n in (40, 50, 90)},
    ),
    "rtg-table-3": PaperSweep(
        title="RTG-SLAM, Table 3: accuracy of the surface with given poses", system="rtg_slam",
        common={"tracking.poses": "given"}, rows={"RTG-SLAM": {}},
        paper={
            name: dict(zip(_GEOMETRY, numbers, strict=True))
            for name, numbers in {
                "NICE-SLAM": (4.45, 74.49, 2.04, 86.63), "Co-SLAM": (5.26, 78.86, 1.06, 96.25),
                "ESLAM": (4.43, 74.51, 1.05, 97.42), "Point-SLAM": (0.67, 99.12, 0.68, 98.94),
                "SplaTAM": (1.32, 95.31, 1.54, 93.55), "RTG-SLAM": (0.95, 96.41, 1.11, 97.16),
            }.items()
        },
        about="Of discs, within 3 cm, on ScanNet++ in the paper; here where the true surface is known (the room).",
    ),
    "rtg-fig-6": PaperSweep(
        title="RTG-SLAM, Fig. 6: with and without transparent Gaussians", system="rtg_slam",
        rows={"with": {"rule.transparent": True}, "opaque only": {"rule.transparent": False}},
        about="The paper shows pictures and no numbers: opaque Gaussians alone give wrong colours from new views.",
    ),
}  # fmt: skip
"""Name on the command line -> sweep. Fig. 7 of RTG-SLAM is ``gsfusion-nb study disc-depth``."""


def beside_paper(name: str, results: Sequence[RunResult]) -> str:
    """Our numbers, means over the seeds, with the paper's in brackets or below them."""
    sweep = PAPER_SWEEPS[name]
    ours = {row: _means([r for r in results if r.status == "done" and r.spec.label == row]) for row in sweep.rows}
    table = PAPER_TABLES.get(sweep.number)
    if table is not None:
        columns = [*dict.fromkeys(c for row in table.rows.values() for c in row), "Gaussians"]
        rows = {row: _columns(values, sweep.views, columns) for row, values in ours.items()}
        text = f"{PaperComparison(sweep.number, rows)!r}\n(in brackets: the paper's numbers)"
    elif sweep.paper:
        text = _text([(f"{row}, here", _geometry(values)) for row, values in ours.items()], sweep.paper)
    else:
        text = _text([(row, _columns(v, sweep.views, ["PSNR", "SSIM", "Gaussians"])) for row, v in ours.items()], {})
    return "\n".join(filter(None, (sweep.title, text, sweep.about)))


def _means(results: Sequence[RunResult]) -> dict[str, float]:
    names = {name for result in results for name in result.metrics}
    return {
        name: sum(values) / len(values)
        for name in names
        if (values := [r.metrics[name] for r in results if name in r.metrics])
    }


def _columns(values: Mapping[str, float], views: str, columns: Sequence[str]) -> dict[str, float]:
    """Our numbers under the headings of the paper."""
    if not values:
        return {}
    known = {
        "PSNR": values.get(f"psnr_{views}_db"), "SSIM": values.get(f"ssim_{views}"),
        "FPS": 1e3 / values["ms_per_frame"], "MB": values.get("model_size_mb"),
        "global s": values.get("seconds_global"), "keyframes": values.get("n_keyframes"),
        "Gaussians": values.get("n_gaussians"),
    }  # fmt: skip
    return {name: number for name in columns if (number := known[name]) is not None}


def _geometry(values: Mapping[str, float]) -> dict[str, float]:
    names = ("disc_accuracy_m", "disc_precision", "disc_completion_m", "disc_completion_ratio")
    return {
        column: 100 * values[name] for column, name in zip(_GEOMETRY, names, strict=True) if name in values
    }  # metres to centimetres, shares to per cent


def _text(ours: Sequence[tuple[str, Row]], paper: Mapping[str, Row]) -> str:
    """Rows as aligned text: ours, then the paper's."""
    rows = [*ours, *((f"{name}, paper", row) for name, row in paper.items())]
    columns = list(dict.fromkeys(column for _, row in rows for column in row))
    width = max(len(name) for name, _ in rows)
    lines = ["  ".join([" " * width, *(f"{c:>13}" for c in columns)])]
    for name, row in rows:
        cells = [f"{row[c]:13,.3f}" if c in row else f"{'-':>13}" for c in columns]
        lines.append("  ".join([f"{name:<{width}}", *cells]))
    return "\n".join(lines)
