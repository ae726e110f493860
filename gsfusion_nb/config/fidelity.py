"""Which published variant of a system some settings follow."""

from collections.abc import Mapping, Sequence
from typing import Any

from .values import to_dict


def fidelity_of(config: Any, variants: Mapping[str, Sequence[Any]]) -> str:
    """The variant that ``config`` follows, with its exceptions: "paper", or "code, but optim.ssim_weight 0.0".

    Only the settings in which the variants differ count. Of equally close variants it is the first.

    Args:
        config: Settings of a system.
        variants: Name -> settings of the same system for each data set, in the same order for every name.
    """
    values = {name: [_leaves(to_dict(c)) for c in configs] for name, configs in variants.items()}
    deciding = {
        key
        for same_data in zip(*values.values(), strict=True)
        for key in same_data[0]
        if any(v[key] != same_data[0][key] for v in same_data)
    }
    mine = {key: value for key, value in sorted(_leaves(to_dict(config)).items()) if key in deciding}
    exceptions = [
        (name, [f"{key} {value}" for key, value in mine.items() if value != v[key]])
        for name, variant in values.items()
        for v in variant
    ]
    closest, others = min(exceptions, key=lambda found: len(found[1]))
    return f"{closest}, but {', '.join(others)}" if others else closest


def _leaves(values: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Nested values by dotted name; the options of the seeding rule are one value."""
    leaves: dict[str, Any] = {}
    for name, value in values.items():
        nested = isinstance(value, dict) and name != "options"
        leaves |= _leaves(value, f"{path}{name}.") if nested else {path + name: value}
    return leaves
