"""Rules, settings, systems and scenes compared by runs with equal budgets. Each name is loaded when first used."""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .entries import Entrant as Entrant
    from .entries import compare_rules as compare_rules
    from .entries import entries_of as entries_of
    from .live_table import LiveTable as LiveTable
    from .one_run import run_spec as run_spec
    from .spec import Budget as Budget
    from .spec import RunResult as RunResult
    from .spec import RunSpec as RunSpec
    from .statistics import compare as compare

_LAZY = {
    "Budget": ".spec",
    "Entrant": ".entries",
    "LiveTable": ".live_table",
    "RunResult": ".spec",
    "RunSpec": ".spec",
    "compare": ".statistics",
    "compare_rules": ".entries",
    "entries_of": ".entries",
    "run_spec": ".one_run",
}


def __getattr__(name: str):
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name], __name__), name)
    raise AttributeError(f"module 'gsfusion_nb.compare' has no attribute {name!r}")


def __dir__():
    return sorted([*globals(), *_LAZY])
