"""``gsfusion-nb sweep``: values of settings compared on one recording, or a table of the papers repeated on it."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ..backends import use_backend
from ..checks import check_name, check_whole
from .command import WhereOptions, run_and_write
from .grid import combinations, parse_axis, with_values
from .map_scene import Entry
from .paper_sweeps import PAPER_SWEEPS, beside_paper
from .run_all import ResultStore
from .spec import Budget, RunSpec


@dataclass(frozen=True, kw_only=True)
class SweepOptions(WhereOptions):
    """Map one recording with every combination of some values, with several seeds, and write a table.

    All values are checked before anything runs. After Ctrl-C the same command continues."""

    data: Annotated[str, tyro.conf.Positional] = "room"
    """Folder of a recording, or "room" for the built-in scene."""
    grid: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["-g"]), tyro.conf.UseAppendAction] = ()
    """Values of a setting: --grid tsdf.voxel-size-m=0.01,0.02; of an option of the rule: --grid rule.fraction=0.1,0.2;
    rules: --grid seeding.rule=gsfusion,my_rules.py:mine. Repeat it for several settings."""
    table: str = ""
    """Instead of --grid, a comparison of the papers, beside its numbers: table-iv (voxel size), table-v (quadtree
    threshold), table-vi (global optimisation), table-vii (random keyframes) or table-viii (keyframe threshold) of
    GSFusion; rtg-table-3 (accuracy), rtg-fig-6 (transparent Gaussians) or rtg-fig-7 (disc depth) of RTG-SLAM."""
    set: tuple[str, ...] = ()
    """Settings of all runs: --set data.width=320 data.height=240 seeding.rule=uniform rule.fraction=0.1."""
    seeds: int = 1
    """Number of seeds: 0, 1, and so on."""
    system: str = "gsfusion"
    """Name of the mapping system; a comparison of a paper chooses it itself."""
    preset: str = ""
    """Settings published for a data set. Default: room for the built-in scene, otherwise replica."""
    reader: tuple[str, ...] = ()
    """Options of the layout's reader, name=value: n_frames=60 (room)."""


def main(options: SweepOptions) -> int:
    """Run the command. Returns the exit status.

    Raises:
        ValueError, KeyError, TypeError: a setting that does not exist, or a value that is refused.
    """
    with use_backend(options.backend):
        specs = sweep_specs(options)
        name = options.table or "sweep"
        folder = Path(options.out or f"runs/{name}-{Path(options.data).name}").expanduser()
        print(f"{len(specs)} runs on {options.data}")
        status = run_and_write(specs, folder, options)
        if options.table and status != 130:
            known = ResultStore(folder, shared=options.cache)
            text = beside_paper(options.table, [r for spec in specs if (r := known.find(spec)) is not None])
            (folder / "beside-paper.txt").write_text(f"{text}\n", encoding="utf-8")
            print(f"\n{text}")
    return status


def sweep_specs(options: SweepOptions) -> list[RunSpec]:
    """All runs of the command, checked.

    Raises:
        ValueError, KeyError, TypeError: as for ``main``.
    """
    check_whole("seeds", options.seeds, 1)
    if bool(options.grid) == bool(options.table):
        raise ValueError("expected either --grid NAME=VALUE,VALUE or --table, such as --table table-iv")
    if options.table:
        check_name("table", options.table, PAPER_SWEEPS)
    paper = PAPER_SWEEPS.get(options.table)
    system = paper.system if paper else options.system
    reader = {name: values[0] for name, values in map(parse_axis, options.reader)}
    base = RunSpec(
        rule=system, scene=Path(options.data).name, data=_place(options.data), reader=reader, system=system,
        preset=options.preset, budget=Budget(steps="own"),
    )  # fmt: skip
    given = [(name, values[0]) for name, values in map(parse_axis, options.set)]
    if paper:
        base = with_values(base, paper.common.items(), base.label)
        base = with_values(base, given, base.label)
        specs = [with_values(base, values.items(), row) for row, values in paper.rows.items()]
        for spec in specs:
            spec.config()
    else:
        base = with_values(base, given, base.label)
        specs = combinations(base, [parse_axis(text) for text in options.grid])
    Entry(spec=specs[0]).opened()
    return [dataclasses.replace(spec, seed=seed) for spec in specs for seed in range(options.seeds)]


def _place(data: str) -> str:
    return data if data == "room" else str(Path(data).expanduser().resolve())
