"""Settings as command-line options, the same for all commands that map:
``--tsdf.voxel-size-m 0.02``.

The system and the preset decide the defaults of all other options. The order of options does not
matter.
"""

import dataclasses
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from ..backends import backend_names, from_environment
from ..checks import check_device
from ..config import SystemConfig, presets, to_dict
from ..config.options import named, named_values
from ..config.values import leaves, with_own_settings
from ..errors import ArgumentError
from .options import EVERYDAY, HELP, parse_options
from .run_settings import read_settings

O = TypeVar("O", bound="SettingsOptions")  # noqa: E741
ROOM = "room"
"""Name of the built-in scene, and of the preset for it."""


def system_names() -> tuple[str, ...]:
    """Names of the mapping systems, also of those that installed packages add."""
    from ..mapping import system_names

    return tuple(system_names())


def layout_names() -> list[str]:
    """Names of the layouts of recordings: those of the files in ``gsfusion_nb/data/readers``."""
    from ..data.open import known_layouts

    return ["auto (recognised by its files)", *known_layouts()]


def fidelity_names() -> list[str]:
    """Names of all fidelities, with the system where it is the only one that has it."""
    from ..mapping import SYSTEMS

    having = {
        name: [
            system for system, mapper in SYSTEMS.items() if name in mapper.description.fidelities
        ]
        for mapper in SYSTEMS.values()
        for name in mapper.description.fidelities
    }
    return [
        f"{name} (only {systems[0]})" if len(systems) == 1 else name
        for name, systems in having.items()
    ]


@dataclass(frozen=True, kw_only=True)
class _RuleOption:
    rule: str | None = None


@dataclass(frozen=True, kw_only=True)
class _StartOptions:
    """The options that decide the defaults of all others: they are parsed first, and the others
    left for later."""

    system: str = ""
    preset: str = ""
    fidelity: str = ""
    from_config: str = ""
    onto: str = ""
    seeding: _RuleOption = field(default_factory=_RuleOption)

    @classmethod
    def of(cls, prog: str, arguments: list[str]) -> "_StartOptions":
        """Those among the arguments of a command."""
        start, _ = tyro.cli(
            cls, prog=prog, args=arguments, return_unknown_args=True, add_help=False
        )
        return start

    def config(self, preset: str) -> SystemConfig:
        """The settings before single options override them: those of ``--from-config``, or of
        system and preset; ``preset`` is the default."""
        from ..mapping import get_system

        if self.from_config:
            return read_settings(
                Path(self.from_config), rule=self.seeding.rule, system=self.system or None
            )
        if self.onto:
            return self._config_onto()
        system = get_system(self.system or "gsfusion")
        if self.fidelity and self.fidelity not in system.description.fidelities:
            raise ArgumentError(
                f"{system.description.title} has no --fidelity {self.fidelity}; known: "
                f"{', '.join(system.description.fidelities) or 'none'}"
            )
        fidelity = {"fidelity": self.fidelity} if self.fidelity else {}
        return system.preset(self.preset or preset, **fidelity)

    def _config_onto(self) -> SystemConfig:
        """The settings of the run in whose map another goes on."""
        from ..runs.onto import check_is_run, settings_onto

        path = Path(self.onto) / "config.json"
        check_is_run(self.onto)
        config = read_settings(path, rule=self.seeding.rule, system=self.system or None)
        return settings_onto(config)

    @property
    def settings_file(self) -> str:
        """The config.json of a run from which the settings come; "" if there is none."""
        return self.from_config or (str(Path(self.onto) / "config.json") if self.onto else "")


@dataclass(frozen=True, kw_only=True)
class SettingsOptions:
    """Which system maps, with which settings, and where."""

    system: str = named("gsfusion", system_names)
    """Name of the mapping system, or one in a file, which is executed: FILE.py:Name."""
    preset: str = named("", presets)
    """Settings for a data set; single options override them. Where none is given: room for the
    built-in scene, otherwise replica."""
    fidelity: str = named("", fidelity_names)
    """What to follow where paper, released code and our measurements differ. Where none is given:
    measured, in each case the choice that gave better results."""
    from_config: str = ""
    """The config.json of an earlier run, whose settings are used instead of system, preset and
    fidelity. A rule of that run in a file is executed, so it has to be named with --seeding.rule,
    and a system in a file with --system."""
    rule_options: tuple[str, ...] = ()
    """Options of the seeding rule, such as: --rule-options share=0.2 transparent=false."""
    device: str = "cpu"
    """Device of the maps: cpu or cuda."""
    backend: str = named(from_environment, backend_names)
    """What the operations run on; the environment variable GSFUSION_BACKEND changes the default."""
    config: SystemConfig = field(default_factory=SystemConfig)

    def settings(self) -> Any:
        """The settings of the system, with the options of the seeding rule."""
        seeding = self.config.seeding
        options = seeding.options | named_values(self.rule_options)
        return dataclasses.replace(
            self.config, seeding=dataclasses.replace(seeding, options=options)
        )

    def said_of_preset(self) -> str:
        """A sentence on what the preset sets besides what concerns the data; "" if that is nothing,
        or not the default.

        Other fidelities take the settings that were published for the preset's data.
        """
        from ..mapping import get_system

        system = get_system(self.system)
        if (
            self.from_config
            or not self.preset
            or self.fidelity not in ("", *system.description.fidelities[:1])
        ):
            return ""
        default = leaves(to_dict(system.config_type()))
        values = leaves(to_dict(system.preset(self.preset)))
        others = [
            f"{name} {value}"
            for name, value in values.items()
            if value != default[name] and not name.startswith(("data.", "seeding.own_settings"))
        ]
        return (
            f"preset {self.preset} sets {', '.join(others)}; the rest is the default"
            if others
            else ""
        )

    def check_device(self) -> None:
        """Raise ``ValueError`` with the reason if the device cannot be used here."""
        check_device("--device", self.device)


def parse(
    options: type[O],
    prog: str,
    arguments: list[str],
    *,
    data: str = "",
) -> O:
    """Parse the options of a command that maps, which include all settings of the chosen system.

    Args:
        options: Class of the command's options.
        prog: Name of the command in its help.
        arguments: Arguments after the command.
        data: Name of the field with the data to map; if that is the built-in scene, its preset is
            the default.

    Raises:
        KeyError, ValueError: unknown system, preset or fidelity, or a file that holds no settings.
    """
    arguments = _with_code_named(prog, arguments)
    start = _StartOptions.of(prog, arguments)
    preset = _default_preset(options, prog, arguments, start, data)
    values = parse_options(
        with_settings(options, start.config(preset)),
        prog=prog,
        arguments=arguments,
        everyday=EVERYDAY,
    )
    own_settings = _settings_in(arguments, values.config)
    return dataclasses.replace(values, config=with_own_settings(values.config, own_settings))


def _default_preset(
    options: type[O],
    prog: str,
    arguments: list[str],
    start: _StartOptions,
    data: str,
) -> str:
    """The preset where none was typed: that of the built-in scene if it is what is mapped.

    The word ``room`` may be the data or the value of another option, so the arguments are parsed
    once to tell.
    """
    usual = "replica"
    if not data or ROOM not in arguments or start.preset:
        return usual
    without_help = [a for a in arguments if a not in HELP]
    values = parse_options(
        with_settings(options, start.config(usual)), prog=prog, arguments=without_help
    )
    return ROOM if getattr(values, data) == ROOM else usual


def _settings_in(arguments: list[str], config: SystemConfig) -> list[str]:
    """Dotted names of the settings that were typed."""
    words = [a.partition("=")[0][2:].replace("-", "_") for a in arguments if a.startswith("--")]
    words += [re.sub(r"(^|\.)no_", r"\1", word) for word in words]
    names = set(leaves(to_dict(config)))
    return [word for word in dict.fromkeys(words) if word in names]


def reader_options(options: Any) -> dict[str, Any]:
    """What ``--format`` and ``--reader`` say, for ``open_sequence``."""
    return ({"format": options.format} if options.format != "auto" else {}) | named_values(
        options.reader
    )


def recording_to_open(options: Any, source: str) -> tuple[str, dict[str, Any]]:
    """The folder to open, and what ``--format`` and ``--reader`` say; another program's recording
    is converted first.

    Of one without poses the reader is told so.
    """
    reader = reader_options(options)
    if source == ROOM or reader.keys() & {"format", "camera"}:
        return source, reader
    from .convert import mappable

    folder, no_poses = mappable(source)
    return folder, {"poses": False} | reader if no_poses else reader


def with_settings(options: type[O], config: SystemConfig) -> type[O]:
    """``options`` with the fields of ``config`` as options beside its own, such as
    ``--tsdf.voxel-size-m``."""
    flat = Annotated[type(config), tyro.conf.arg(name="")]
    fields = [("config", flat, field(default_factory=lambda: config))]
    cls: Any = dataclasses.make_dataclass(
        options.__name__, fields, bases=(options,), frozen=True, kw_only=True
    )
    cls.__doc__ = options.__doc__
    return cls


def _with_code_named(prog: str, arguments: list[str]) -> list[str]:
    """``arguments`` and, if the user allows it, the rule and the system in files that
    ``--from-config``, or the run of ``--onto``, asks for.

    Nothing is executed for a help text, so nobody is asked there.

    Raises:
        SequenceError: as ``ask_or_refuse``. ValueError: options that these exclude.
    """
    from ..seeding.code_files import is_code_file
    from ..seeding.named_code import CodeNotNamedError
    from .permission import ask_or_refuse

    start = _StartOptions.of(prog, arguments)
    if not start.settings_file:
        return arguments
    option = "--onto" if start.onto else "--from-config"
    names = ("preset", "fidelity", *(("from_config",) if start.onto else ()))
    others = [f"--{name.replace('_', '-')}" for name in names if getattr(start, name)]
    if start.system and not (start.onto or is_code_file(start.system)):
        others.insert(0, "--system")
    if others:
        raise ArgumentError(
            f"{option} sets all settings; leave out {' '.join(others)}, or {option}"
        )
    options = {"rule": "--seeding.rule", "system": "--system"}
    while True:
        try:
            start.config("")
        except CodeNotNamedError as e:
            naming = [options[e.kind], *e.code]
            if not HELP & set(arguments):
                ask_or_refuse(e, prog, arguments, naming)
            arguments = [*arguments, *naming]
            start = _StartOptions.of(prog, arguments)
        else:
            return arguments
