"""``gsfusion-nb sweep``: one recording with all combinations of some values."""

import itertools
from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from ..backends import use_backend
from ..checks import shown
from ..config.options import named, parse_value
from ..errors import ArgumentError
from ..mapping import system_names
from .command import run_and_write
from .recording_specs import RULE, RecordingOptions, output_folder, recording_specs
from .spec import RunSpec


@dataclass(frozen=True, kw_only=True)
class SweepOptions(RecordingOptions):
    """Map one recording with every combination of some values, with several seeds, and write a
    table.

    All values are checked before anything runs. After Ctrl-C the same command continues."""

    data: Annotated[str, tyro.conf.Positional] = "room"
    """Folder of a recording, or "room" for the built-in scene."""
    grid: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["-g"]), tyro.conf.UseAppendAction] = ()
    """Values of a setting: --grid tsdf.voxel-size-m=0.01,0.02; of an option of the rule: --grid
    rule.fraction=0.1,0.2; rules: --grid seeding.rule=gsfusion,my_rules.py:mine. Repeat it for
    several settings."""
    system: str = named("gsfusion", system_names)
    """Name of the mapping system, or one in a file, which is executed: FILE.py:Name."""


def sweep(options: SweepOptions) -> int:
    """Run ``gsfusion-nb sweep``. Returns the exit status.

    Raises:
        ValueError, KeyError, TypeError: a setting that does not exist, or a value that is refused.
    """
    with use_backend(options.backend):
        specs = sweep_specs(options)
        print(f"{len(specs)} runs, on {options.data}")
        return run_and_write(specs, output_folder(options, "sweep", options.data), options)[0]


def sweep_specs(options: SweepOptions) -> list[RunSpec]:
    """All runs of a sweep, checked.

    Raises:
        ValueError, KeyError, TypeError: as for ``sweep``.
    """
    if not options.grid:
        raise ArgumentError("expected --grid NAME=VALUE,VALUE")
    axes = dict(parse_axis(text) for text in options.grid)
    if len(axes) < len(options.grid):
        raise ArgumentError(f"expected each setting once, got {', '.join(options.grid)}")
    variants = {}
    for values in itertools.product(*axes.values()):
        pairs = dict(zip(axes, values, strict=True))
        label = ", ".join(
            str(v) if n == RULE else f"{n.rpartition('.')[2]} {v}" for n, v in pairs.items()
        )
        variants[label] = {"system": options.system, **pairs}
    return recording_specs(variants, options, options.data)


def parse_axis(text: str) -> tuple[str, list[Any]]:
    """Name and values of ``NAME=VALUE,VALUE,...``: numbers, true, false, or words.

    Raises:
        ValueError: no name, no value, or a value twice.
    """
    name, equals, values = text.partition("=")
    axis = [parse_value(v.strip()) for v in values.split(",") if v.strip()]
    if not equals or not name or not axis:
        raise ArgumentError(f"expected values of a setting as NAME=VALUE,VALUE, got {shown(text)}")
    if len({str(v) for v in axis}) < len(axis):
        raise ArgumentError(f"expected values that differ, got {shown(text)}")
    return name.strip().replace("-", "_"), axis
