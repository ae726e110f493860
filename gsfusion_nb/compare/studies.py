"""Runs on one recording: all combinations of some values (``sweep``), and named comparisons (``study``).

The named comparisons are those of the papers, beside their numbers, and the questions that this project asked itself.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from ..backends import use_backend
from ..checks import check_name, check_whole, shown
from ..course.paper_tables import PaperComparison
from ..files import SequenceError, parse_json
from ..mapping import get_system
from ..seeding import check_options
from ..seeding.rule_code import is_rule_file, read_rule_file
from . import disc_depth, roofline
from .command import WhereOptions, run_and_write
from .map_scene import Entry
from .spec import Budget, RunResult, RunSpec
from .statistics import Group, group_runs

Values = Mapping[str, Any]
"""Name -> value: "system", "fidelity", "seeding.rule", an option of the rule as "rule.<name>", or a setting."""


@dataclass(frozen=True)
class Study:
    """Runs that differ in one respect, and the question that they answer."""

    question: str
    variants: Mapping[str, Values]
    """Label -> what is set."""
    common: Values = dataclasses.field(default_factory=dict)
    """What is set in all variants."""
    table: str = ""
    """Number of the table in ``PAPER_TABLES`` that is printed beside our numbers."""
    views: str = "held_out"
    """Views that this table scores: held_out or mapped."""
    about: str = ""
    """A sentence under the table."""


_RTG: Values = {"system": "rtg_slam"}
_TRACKED: Values = {"tracking.poses": "tracked"}
_GPS_ONLINE: Values = {"system": "gps_slam", "final.passes": 0}
_EQUAL: Values = {"tsdf.colour_by_distance": False}
_TITLES = {"gsfusion": "GSFusion", "rtg_slam": "RTG-SLAM", "gps_slam": "GPS-SLAM"}
STUDIES: dict[str, Study] = {
    "systems": Study("The three systems, with given and with tracked poses", {
        f"{title}, {poses}": {"system": system, "tracking.poses": poses}
        for poses in ("given", "tracked") for system, title in _TITLES.items()
    }),
    "transparent": Study(
        "RTG-SLAM with and without transparent Gaussians (Peng et al. 2024, Fig. 6)",
        {"with transparent": {"rule.transparent": True}, "opaque only": {"rule.transparent": False}}, _RTG,
        about="The paper shows pictures and no numbers: opaque Gaussians alone give wrong colours from new views.",
    ),
    "states": Study(
        "RTG-SLAM: optimise the unstable Gaussians and their pixels, or everything",
        {"unstable only": {}, "all Gaussians": {"window.only_unstable": False}}, _RTG,
    ),
    "fidelity": Study("The three systems as measured, as in their papers and as released", {
        f"{title}, {name}": {"system": system, "fidelity": name, "data.hold_out_every": 8}
        for system, title in _TITLES.items() for name in ("measured", "paper", "code")
    }),
    "gsfusion-settings": Study(
        "GSFusion: the settings in which paper, released code and our defaults differ, changed one at a time", {
            "measured": {},
            "seeding.without_depth skip (both)": {"seeding.without_depth": "skip"},
            "optim.adam_steps shared (both)": {"optim.adam_steps": "shared"},
            "optim.adam_steps per_row": {"optim.adam_steps": "per_row"},
            "optim.ssim_weight 0 (paper)": {"optim.ssim_weight": 0},
            "tsdf.sdf z (paper)": {"tsdf.sdf": "z"},
            "tsdf.average eq9 (paper)": {"tsdf.average": "eq9"},
            "tsdf.average int16 (code)": {"tsdf.average": "int16"},
            "tsdf.outlier_guard off (both)": {"tsdf.outlier_guard": False},
            "seeding.one_per_voxel on (paper)": {"seeding.one_per_voxel": True},
        },
    ),
    "rtg-slam-settings": Study(
        "RTG-SLAM: the settings that our defaults take from measurements, set to the published value one at a time", {
            "measured": {},
            "discs.opaque_alpha 0.61 (paper)": {"discs.opaque_alpha": 0.6065},
            "discs.min_cosine 0.5 (both)": {"discs.min_cosine": 0.5},
            "discs.max_offset 1 (code)": {"discs.max_offset": 1},
            "discs.max_offset none (paper)": {"discs.max_offset": None},
            "share 0.05 (both)": {"rule.share": 0.05},
            "window.lr_sh 5e-4, 2.5e-5 (code)": {"window.lr_sh_dc": 5e-4, "window.lr_sh_rest": 2.5e-5},
            "window.lr_log_scale 4e-3 (code)": {"window.lr_log_scale": 4e-3},
            "window.draw random (paper)": {"window.draw": "random"},
            "states.stable_confidence 100 (code)": {"states.stable_confidence": 100},
            "states.age all (both)": {"states.age": "all"},
        }, _RTG,
    ),
    "depth": Study(
        "RTG-SLAM online with disc depth or blended depth",
        {"disc depth": {}, "blended depth": {"discs.depth": "blended"}}, _RTG,
    ),
    "rate": Study(
        "Rate against held-out PSNR while mapping, without passes: GPS-SLAM with one changed setting beside GSFusion", {
            "GSFusion": {"optim.global_iterations": 0},
            "GPS-SLAM": _GPS_ONLINE,
            "10 steps": {**_GPS_ONLINE, "schedule.iterations": 10},
            "30 steps": {**_GPS_ONLINE, "schedule.iterations": 30},
            "40 steps": {**_GPS_ONLINE, "schedule.iterations": 40},
            "most 0.005": {**_GPS_ONLINE, "rule.most": 0.005},
            "most 0.04": {**_GPS_ONLINE, "rule.most": 0.04},
            "2 looks": {**_GPS_ONLINE, "schedule.recalled": 2, "schedule.recalled_new": 1},
            "full looks": {**_GPS_ONLINE, "base.resolution": "full"},
            "voxels 2 cm": {**_GPS_ONLINE, "tsdf.voxel_size_m": 0.02},
            "voxels 0.7 cm": {**_GPS_ONLINE, "tsdf.voxel_size_m": 0.007},
        },
    ),
    "colours": Study(
        "The TSDF's picture and its mesh, without Gaussians, by how its colours are weighted", {
            "band of 1.5 voxels and 1/z^2": {},
            "band of 1.5 voxels": _EQUAL,
            "band of 2 voxels": {**_EQUAL, "tsdf.colour_band_voxels": 2},
            "1/z^2": {"tsdf.colour_band_voxels": 0},
            "equal weights": {**_EQUAL, "tsdf.colour_band_voxels": 0},
        }, {**_GPS_ONLINE, "rule.share": 0.0},
    ),
    "tracking": Study(
        "RTG-SLAM's tracker: the surface it aligns to, and the back end", {
            "hybrid (released code)": {},
            "model (paper)": {"tracking.target": "model"},
            "hybrid, without landmarks": {"tracking.landmarks": False},
            "hybrid, back end": {"tracking.back_end": True},
        }, {**_RTG, **_TRACKED},
    ),
    "table-iv": Study(
        "GSFusion, Table IV: voxel size", {"1 cm": {"tsdf.voxel_size_m": 0.01}, "5 cm": {"tsdf.voxel_size_m": 0.05}},
        table="IV",
    ),
    "table-v": Study(
        "GSFusion, Table V: quadtree threshold",
        {"0.01": {"seeding.quadtree_threshold": 0.01}, "0.1": {"seeding.quadtree_threshold": 0.1}}, table="V",
        about="The released contrast grows with the number of pixels: on small images a threshold gives fewer cells.",
    ),
    "table-vi": Study(
        "GSFusion, Table VI: passes of the global optimisation",
        {str(n): {"optim.global_iterations": n} for n in (0, 10, 20)}, table="VI",
    ),
    "table-vii": Study(
        "GSFusion, Table VII: random keyframe optimisation", {
            "without": {"optim.frame_iterations": 5, "optim.random_keyframe_iterations": 0},
            "with": {"optim.frame_iterations": 3, "optim.random_keyframe_iterations": 2},
        }, {"optim.global_iterations": 0}, table="VII", views="mapped",
        about="Both rows take 5 steps after each frame, as the equal speed in the paper implies.",
    ),
    "table-viii": Study(
        "GSFusion, Table VIII: keyframe threshold", {str(n): {"keyframe_min_seeds": n} for n in (40, 50, 90)},
        table="VIII", views="mapped",
    ),
}  # fmt: skip
"""Name on the command line -> study. "disc-depth" (Fig. 7 of RTG-SLAM) and "roofline" have modules of their own."""
RULE, OPTION = "seeding.rule", "rule."
"""The setting whose values are rules, and the beginning of the names of a rule's options."""


@dataclass(frozen=True, kw_only=True)
class RecordingOptions(WhereOptions):
    """What is mapped."""

    set: tuple[str, ...] = ()
    """Settings of all runs: --set data.width=320 data.height=240 seeding.rule=uniform rule.fraction=0.1."""
    seeds: int = 1
    """Number of seeds: 0, 1, and so on."""
    preset: str = ""
    """Settings published for a data set. Default: room for the built-in scene, otherwise replica."""
    reader: tuple[str, ...] = ()
    """Options of the layout's reader, name=value: n_frames=60 (room)."""


@dataclass(frozen=True, kw_only=True)
class SweepOptions(RecordingOptions):
    """Map one recording with every combination of some values, with several seeds, and write a table.

    All values are checked before anything runs. After Ctrl-C the same command continues."""

    data: Annotated[str, tyro.conf.Positional] = "room"
    """Folder of a recording, or "room" for the built-in scene."""
    grid: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["-g"]), tyro.conf.UseAppendAction] = ()
    """Values of a setting: --grid tsdf.voxel-size-m=0.01,0.02; of an option of the rule: --grid rule.fraction=0.1,0.2;
    rules: --grid seeding.rule=gsfusion,my_rules.py:mine. Repeat it for several settings."""
    system: str = "gsfusion"
    """Name of the mapping system."""


@dataclass(frozen=True, kw_only=True)
class StudyOptions(RecordingOptions):
    """Run a named comparison on one recording and print a table.

    A variant that was run before, by any command, is taken from the cache."""

    name: Annotated[str, tyro.conf.Positional]
    """What to compare: systems (all three), transparent (with and without transparent Gaussians), states (optimising
    unstable or all Gaussians), fidelity (as measured, paper or released code), gsfusion-settings and rtg-slam-settings
    (one changed setting at a time), depth (disc or blended depth), tracking (variants of the tracker), rate (GPS-SLAM's
    frames per second against its PSNR), colours (weights of the TSDF's colours, without Gaussians), disc-depth (depth
    of single images), roofline (kernels and the limits of this machine), or an ablation of GSFusion's paper, beside its
    numbers: table-iv (voxel size), table-v (quadtree threshold), table-vi (global optimisation), table-vii (random
    keyframes), table-viii (keyframe threshold)."""
    data: Annotated[str, tyro.conf.Positional] = "room"
    """Folder of a sequence, or "room" for the built-in scene."""
    only: str = ""
    """Only the variants whose name contains this text, in capital or small letters: --only given. Default: all."""
    views: int = 20
    """Only for disc-depth: number of views to fit."""
    device: str = "cpu"
    """Only for roofline: the device to measure, cpu or cuda."""


def sweep(options: SweepOptions) -> int:
    """Run ``gsfusion-nb sweep``. Returns the exit status.

    Raises:
        ValueError, KeyError, TypeError: a setting that does not exist, or a value that is refused.
    """
    with use_backend(options.backend):
        specs = sweep_specs(options)
        print(f"{len(specs)} runs, on {options.data}")
        return run_and_write(specs, _folder(options, "sweep", options.data), options)[0]


def study(options: StudyOptions) -> int:
    """Run ``gsfusion-nb study``. Returns the exit status.

    Raises:
        KeyError: no such study. ValueError: ``only`` leaves nothing.
    """
    name = options.name
    check_name("study", name, ("disc-depth", "roofline", *STUDIES))
    folder = _folder(options, f"study-{name}", options.data)
    if name in ("disc-depth", "roofline"):
        folder.mkdir(parents=True, exist_ok=True)
        if name == "roofline":
            return roofline.main(options.device, folder)
        return disc_depth.main(options.data, folder, options.views)
    asked = STUDIES[name]
    with use_backend(options.backend):
        specs = study_specs(name, options, options.data, options.only)
        print(f"{asked.question}, on {options.data}")
        status, results = run_and_write(specs, folder, options)
        if asked.table:
            print(beside_paper(asked, results))
    return status


def _folder(options: RecordingOptions, name: str, data: str) -> Path:
    return Path(options.out or f"runs/{name}-{Path(data).name}").expanduser()


def sweep_specs(options: SweepOptions) -> list[RunSpec]:
    """All runs of a sweep, checked.

    Raises:
        ValueError, KeyError, TypeError: as for ``sweep``.
    """
    if not options.grid:
        raise ValueError("expected --grid NAME=VALUE,VALUE")
    axes = dict(parse_axis(text) for text in options.grid)
    if len(axes) < len(options.grid):
        raise ValueError(f"expected each setting once, got {', '.join(options.grid)}")
    variants = {}
    for values in itertools.product(*axes.values()):
        pairs = dict(zip(axes, values, strict=True))
        label = ", ".join(str(v) if n == RULE else f"{n.rpartition('.')[2]} {v}" for n, v in pairs.items())
        variants[label] = {"system": options.system, **pairs}
    return _specs(variants, options, options.data, online=False)


def study_specs(name: str, options: RecordingOptions, data: str, only: str = "") -> list[RunSpec]:
    """All runs of a study, checked.

    Raises:
        ValueError, KeyError, TypeError: no variant whose name contains ``only``, or a setting that is refused.
    """
    asked = STUDIES[name]
    variants = {label: values for label, values in asked.variants.items() if only.lower() in label.lower()}
    if not variants:
        raise ValueError(f"--only: no variant's name contains {only!r}; there are {', '.join(asked.variants)}")
    return _specs(variants, options, data, common=asked.common, online=True)


def _specs(
    variants: Mapping[str, Values], options: RecordingOptions, data: str, *, common: Values | None = None, online: bool
) -> list[RunSpec]:
    check_whole("seeds", options.seeds, 1)
    place = data if data == "room" else str(Path(data).expanduser().resolve())
    shared = {**(common or {}), **{name: values[0] for name, values in map(parse_axis, options.set)}}
    reader = {name: values[0] for name, values in map(parse_axis, options.reader)}
    fields = {"scene": Path(data).name, "data": place, "reader": reader, "preset": options.preset, "online": online}
    specs = [spec_with({**shared, **values}, label, **fields) for label, values in variants.items()]
    for spec in specs:
        spec.config()
        check_options(Entry(spec=spec).found_rule(), spec.options)
    Entry(spec=specs[0]).opened()
    return [dataclasses.replace(spec, seed=seed) for spec in specs for seed in range(options.seeds)]


def spec_with(values: Values, label: str, **fields: Any) -> RunSpec:
    """A run with some values set; its rule and the options of the rule are those of its system otherwise.

    Args:
        values: What is set.
        label: Name in tables.
        fields: Other fields of ``RunSpec``.

    Raises:
        ValueError: the file of a rule cannot be read. FileNotFoundError: it does not exist.
    """
    values = dict(values)
    system, fidelity = values.pop("system", "gsfusion"), values.pop("fidelity", "")
    base = RunSpec(rule=system, label=label, system=system, fidelity=fidelity, budget=Budget(steps="own"), **fields)
    own = get_system(system).preset(base.preset, **({"fidelity": fidelity} if fidelity else {})).seeding
    rule = values.pop(RULE, own.rule)
    options = dict(own.options) if rule == own.rule else {}
    options |= {name.removeprefix(OPTION): v for name, v in values.items() if name.startswith(OPTION)}
    settings = {name: v for name, v in values.items() if not name.startswith(OPTION)}
    source = read_rule_file(rule)[0] if is_rule_file(rule) else ""
    return dataclasses.replace(base, rule=rule, options=options, settings=settings, rule_source=source)


def parse_axis(text: str) -> tuple[str, list[Any]]:
    """Name and values of ``NAME=VALUE,VALUE,...``: numbers, true, false, or words.

    Raises:
        ValueError: no name, no value, or a value twice.
    """
    name, equals, values = text.partition("=")
    found = [_value(v.strip()) for v in values.split(",") if v.strip()]
    if not equals or not name or not found:
        raise ValueError(f"expected values of a setting as NAME=VALUE,VALUE, got {shown(text)}")
    if len({str(v) for v in found}) < len(found):
        raise ValueError(f"expected values that differ, got {shown(text)}")
    return name.strip().replace("-", "_"), found


def _value(text: str) -> Any:
    try:
        return parse_json(text.lower() if text.lower() in ("true", "false") else text, text, "a value")
    except SequenceError:
        return text


def beside_paper(asked: Study, results: Sequence[RunResult]) -> str:
    """Our numbers, means over the seeds, with the paper's in brackets."""
    groups = {g.label: g for g in group_runs(results)}
    rows = {label: groups[label] for label in asked.variants if label in groups and groups[label].runs}
    ours = {label: _in_the_papers_columns(group, asked.views) for label, group in rows.items()}
    text = f"{PaperComparison(asked.table, ours)!r}\n(in brackets: the paper's numbers)"
    return "\n".join(filter(None, (asked.question, text, asked.about)))


def _in_the_papers_columns(group: Group, views: str) -> dict[str, float]:
    """Our numbers under the headings of the paper."""
    names = {
        "PSNR": f"psnr_{views}_db", "SSIM": f"ssim_{views}", "MB": "model_size_mb", "global s": "seconds_global",
        "keyframes": "n_keyframes", "Gaussians": "n_gaussians",
    }  # fmt: skip
    found = {name: group.summary(metric).mean for name, metric in names.items() if group.summary(metric).n}
    ms = group.summary("ms_per_frame")
    return found | ({"FPS": 1e3 / ms.mean} if ms.n else {})
