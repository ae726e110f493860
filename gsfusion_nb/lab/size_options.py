"""The option of each rule that decides how many Gaussians it makes, which is tuned to reach a budget."""

from dataclasses import dataclass

from ..errors import shown
from ..seeding import SeedingRule, rule_name, rule_options
from .schedule import dotted
from .setting_names import flat_settings
from .spec import RunSpec, label_of

THIN = "thin"
"""Size option of any rule: the share of its seeds that is kept, drawn at random."""


@dataclass(frozen=True, kw_only=True)
class SizeOption:
    """A number that decides how many Gaussians a rule makes."""

    name: str
    """Option of the rule, a dotted setting, or "thin"."""
    low: float | int
    """Smallest value that is tried."""
    high: float | int
    """Largest value that is tried."""


SHARE = SizeOption(name="share", low=1e-5, high=1.0)
SIZE_OPTIONS: dict[str, SizeOption] = {
    "gsfusion": SizeOption(name="seeding.quadtree_threshold", low=1e-6, high=100.0),
    "uniform": SizeOption(name="fraction", low=1e-5, high=1.0),
    "edge_discs": SizeOption(name="spacing_px", low=1.0, high=200.0),
    "edge_strokes": SizeOption(name="spacing_px", low=1.0, high=200.0),
    "monogs": SizeOption(name="density", low=1e-4, high=128.0),
    "monogs_like": SizeOption(name="density", low=1e-4, high=128.0),
    "photo_slam": SizeOption(name="corners", low=1, high=100_000),
    "gs_icp": SizeOption(name="density", low=1e-3, high=100.0),
    "on_the_fly_nvs": SizeOption(name="density", low=1e-4, high=1e4),
    **dict.fromkeys(("default_strategy", "mcmc"), SHARE),
    **dict.fromkeys(("cg_slam", "gaus_slam", "gaussian_slam", "gps_slam", "gs_slam", "hf_slam", "mm3dgs"), SHARE),
    **dict.fromkeys(("rtg_slam", "splatam", "splatam_like", "two_dgs_slam", "vings", "vtgaussian"), SHARE),
}
"""Registered rule -> its size option."""


def size_option(spec: RunSpec, rule: SeedingRule) -> SizeOption:
    """The size option of a run: the one that ``spec`` names, else the rule's own.

    Raises:
        ValueError: there is none, the rule does not have it, or it is not a number.
    """
    known = SIZE_OPTIONS.get(rule_name(rule)) if not spec.rule_source and not spec.rule_hash else None
    name = dotted(spec.size_option) or (known.name if known else "")
    if not name:
        raise ValueError(
            f"the rule {rule_name(rule)} has no size option: name the option that changes its number of Gaussians as "
            f'size_option (its options: {", ".join(rule_options(rule)) or "none"}), or "{THIN}", which keeps a random '
            f"share of its seeds"
        )
    if known is not None and name == known.name and spec.size_range is None:
        return known
    low, high = spec.size_range or _usual_range(spec, rule, name)
    return SizeOption(name=name, low=low, high=high)


def start_value(spec: RunSpec, rule: SeedingRule, option: SizeOption) -> float | int:
    """The value of the size option before it is tuned.

    Raises:
        ValueError: the rule and the settings do not have it, or it is not a number.
    """
    if option.name == THIN:
        return spec.keep_share
    values = {**flat_settings(spec.config()), **rule_options(rule), **spec.options}
    if option.name not in values:
        known = ", ".join([*rule_options(rule), THIN])
        raise ValueError(f"the rule {rule_name(rule)} has no option {shown(option.name)} to tune; known: {known}")
    value = values[option.name]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or value <= 0:
        raise ValueError(f"the size option {option.name} must be a number above 0, got {shown(value)}")
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


def described(option: SizeOption, value: float | int) -> str:
    """The tuned value in words: "fraction=0.1"."""
    return label_of("", {option.name: value}).strip()


def _usual_range(spec: RunSpec, rule: SeedingRule, name: str) -> tuple[float | int, float | int]:
    if name == THIN:
        return 1e-5, 1.0
    start = start_value(spec, rule, SizeOption(name=name, low=0, high=0))
    if isinstance(start, float) and start <= 1 and "." not in name:
        return 1e-5, 1.0
    return (1, 1000 * start) if isinstance(start, int) else (start / 1e4, start * 1e4)
