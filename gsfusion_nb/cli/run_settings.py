"""The settings of an earlier run, read from its config.json."""

from pathlib import Path
from typing import TYPE_CHECKING

from ..checks import shown
from ..config import SystemConfig, from_run
from ..errors import ArgumentError, reason_of
from ..files import read_object

if TYPE_CHECKING:
    from ..seeding.named_code import RuleNotNamedError


def read_settings(path: Path, rule: str | None = None, system: str | None = None) -> SystemConfig:
    """The settings in a run's config.json; ``rule`` is the seeding rule to use instead of the
    run's, if given, and ``system`` names the file of the run's system.

    Raises:
        CodeNotNamedError: its rule or its system is in a file, and none is given.
        ValueError: not the config.json of a run, or its rule is not part of this package and no
            other is given.
    """
    from ..runs.system_of_run import system_of_run
    from ..seeding import registered
    from ..seeding.code_files import file_source, is_code_file

    document = read_object(path, "the config.json of a run", objects=("config",))
    name = document.get("rule")
    values = document["config"]
    seeding = values.get("seeding")
    in_settings = seeding.get("rule") if isinstance(seeding, dict) else None
    if isinstance(in_settings, str) and is_code_file(in_settings):
        if rule is None:
            raise _not_named(path, in_settings)
        values = {**values, "seeding": {**seeding, "rule": in_settings.rpartition(":")[2]}}
    mapper = system_of_run(path.parent, document, system, lambda own: f"--system {own}")
    try:
        config = from_run(mapper.config_type, values)
        own_rule = config.seeding.rule
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as e:
        raise ArgumentError(f"{path} is not the config.json of a run: {reason_of(e)}") from None
    training = document.get("training")
    if training and isinstance(training, dict):
        kinds = ", ".join(f"{kind} {shown(name)}" for kind, name in training.items())
        raise ArgumentError(
            f"{path} is of a run with its own {kinds}; repeat it in Python, run_mapping(..., "
            "loss=...)"
        )
    name = own_rule if name is None else name
    is_of_system = bool(file_source(mapper)) and (
        file_source(registered().get(str(name))) == file_source(mapper)
    )
    if rule is None and is_of_system:
        return config
    if rule is None and document.get("rule_from_file") and (path.parent / "rule.py").is_file():
        raise _not_named(path, f"{path.parent / 'rule.py'}:{name}")
    if rule is None and not document.get("rule_is_built_in", name == own_rule):
        raise ArgumentError(
            f"{path} is from a run with the seeding rule {shown(name)}, which is not part of this "
            f"package, so it cannot be used here; its source is in {path.parent / 'rule.py'}. "
            "Repeat the run in Python, with run_mapping(data, config, seeding=<the rule>), or "
            "choose another rule with --seeding.rule"
        )
    return config


def _not_named(path: Path, rule: str) -> "RuleNotNamedError":
    from ..seeding.named_code import RuleNotNamedError

    return RuleNotNamedError(path, [rule], f"--seeding.rule {rule}")
