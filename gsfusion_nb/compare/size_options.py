"""The option of a rule that decides how many seeds it makes."""

from dataclasses import dataclass

from ..checks import shown
from ..errors import ArgumentError
from ..seeding import SeedingRule, is_built_in, rule_name, rule_options
from .map_scene import original
from .schedule import dotted, flat_settings
from .spec import RunSpec

THIN = "thin"
"""Size option of any rule: the share of its seeds that is kept, drawn at random."""


@dataclass(frozen=True)
class SizeOption:
    """A number that decides how many Gaussians a rule makes."""

    name: str
    """Option of the rule, a dotted setting, or "thin"."""
    low: float | int
    """Smallest value that is tried."""
    high: float | int
    """Largest value that is tried."""


_SHARE = SizeOption("share", 1e-5, 1.0)
SIZE_OPTIONS: dict[str, SizeOption] = {
    "gsfusion": SizeOption("coarseness", 1e-3, 1e3),
    "vg_mapping": SizeOption("seeding.quadtree_threshold", 1e-6, 100.0),
    "uniform": SizeOption("fraction", 1e-5, 1.0),
    **dict.fromkeys(("edge_discs", "edge_strokes"), SizeOption("spacing_px", 1.0, 200.0)),
    **dict.fromkeys(("monogs", "monogs_like"), SizeOption("density", 1e-4, 128.0)),
    "photo_slam": SizeOption("corners", 1, 100_000),
    "gs_icp": SizeOption("density", 1e-3, 100.0),
    "on_the_fly_nvs": SizeOption("density", 1e-4, 1e4),
    "cone_gs": SizeOption("share", 1e-5, 1e3),
    **dict.fromkeys(("default_strategy", "mcmc", "game"), _SHARE),
    **dict.fromkeys(
        ("cg_slam", "gaus_slam", "gaussian_slam", "gps_slam", "gs_slam", "hf_slam", "mm3dgs"),
        _SHARE,
    ),
    **dict.fromkeys(
        ("rtg_slam", "splatam", "splatam_like", "two_dgs_slam", "vings", "vtgaussian"), _SHARE
    ),
}
"""Registered rule -> its size option."""


def size_option(spec: RunSpec, rule: SeedingRule) -> SizeOption:
    """The size option of a run: the one that ``spec`` names, else the rule's own.

    Raises:
        ValueError: there is none, the rule does not have it, or it is not a number.
    """
    option = SIZE_OPTIONS.get(rule_name(rule)) if is_built_in(original(rule)) else None
    name = dotted(spec.size_option) or (option.name if option else "")
    if not name:
        raise ArgumentError(
            f"the rule {rule_name(rule)} has no size option: name the option that changes its "
            "number of Gaussians as "
            f'size_option (its options: {", ".join(rule_options(rule)) or "none"}), or "{THIN}", '
            "which keeps a random "
            f"share of its seeds"
        )
    if option is not None and name == option.name and spec.size_range is None:
        return option
    low, high = spec.size_range or _usual_range(spec, rule, name)
    return SizeOption(name, low, high)


def start_value(spec: RunSpec, rule: SeedingRule, option: SizeOption) -> float | int:
    """The value of the size option before it is tuned.

    Raises:
        ValueError: the rule and the settings do not have it, or it is not a number.
    """
    if option.name == THIN:
        return spec.keep_share
    values = {**flat_settings(spec.config()), **rule_options(rule), **spec.options}
    if option.name not in values:
        names = ", ".join([*rule_options(rule), THIN])
        raise ArgumentError(
            f"the rule {rule_name(rule)} has no option {shown(option.name)} to tune; known: {names}"
        )
    value = values[option.name]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or value <= 0:
        raise ArgumentError(
            f"the size option {option.name} must be a number above 0, got {shown(value)}"
        )
    return value


def with_size(spec: RunSpec, option: SizeOption, value: float | int) -> RunSpec:
    """``spec`` with another value of the size option; its label stays."""
    values = spec.to_json()
    if option.name == THIN:
        values["keep_share"] = value
    elif "." in option.name:
        values["settings"] = {**values["settings"], option.name: value}
    else:
        values["options"] = {**values["options"], option.name: value}
    return RunSpec.from_json(values)


def _usual_range(
    spec: RunSpec,
    rule: SeedingRule,
    name: str,
) -> tuple[float | int, float | int]:
    if name == THIN:
        return 1e-5, 1.0
    start = start_value(spec, rule, SizeOption(name, 0, 0))
    if isinstance(start, float) and start <= 1 and "." not in name:
        return 1e-5, 1.0
    return (1, 1000 * start) if isinstance(start, int) else (start / 1e4, start * 1e4)
