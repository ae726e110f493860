"""The seeding lab: rules, settings and scenes compared by runs with equal budgets."""

from .one_run import run_spec as run_spec
from .result import RunResult as RunResult
from .spec import Budget as Budget
from .spec import RunSpec as RunSpec
