"""The mapping systems by name: those of this package, which are in ``SYSTEMS``, those that
installed packages add, and systems of the user's own."""

import dataclasses
from pathlib import Path
from typing import Any, TypeVar

import torch

from ..code_keys import CodeKey, code_key
from ..config import SystemConfig
from ..errors import ArgumentError, KindError, UnknownNameError
from ..extensions import Extension, extensions
from ..optim import UpdateFunction
from ..seeding import SeedingRule
from ..seeding.code_files import (
    code_folder,
    is_code_file,
    module_of_source,
    read_code_file,
    register_rules_in,
)
from .check_system import check_system
from .gps_slam import GPSSLAM
from .gsfusion import GSFusion
from .mapper import Mapper
from .rtg_slam import RTGSLAM
from .training import LossFunction, given_functions

M = TypeVar("M", bound=type[Mapper])

SYSTEMS: dict[str, type[Mapper]] = {
    "gsfusion": GSFusion,
    "rtg_slam": RTGSLAM,
    "gps_slam": GPSSLAM,
}
"""The systems of this package."""

_REGISTERED: dict[str, type[Mapper]] = {}
"""Systems that were defined in this process, by the names of their classes, and those of installed
packages that were asked for."""
_NAMES: dict[type[SystemConfig], tuple[str, type[Mapper]]] = {
    mapper.config_type: (name, mapper) for name, mapper in SYSTEMS.items()
}
"""Class of settings -> name and class of their system, of all systems that were loaded."""

_FILE = "a mapping system"


def mapping_system(mapper: M) -> M:
    """Register a system of a notebook or a script under the name of its class, and return it
    unchanged; an earlier one of that name is replaced.

    Raises:
        TypeError: the class is not a system (``check_system``).
        ValueError: a system of this package has its name, title or settings.
    """
    check_system(mapper, "@mapping_system")
    _add(mapper.__name__, mapper, "@mapping_system")
    _REGISTERED[mapper.__name__] = mapper
    return mapper


def system_names() -> list[str]:
    """Names of all systems that can be asked for by one; of installed packages nothing is
    imported."""
    return list(dict.fromkeys([*SYSTEMS, *_REGISTERED, *_installed()]))


def get_system(name: str | type[Mapper]) -> type[Mapper]:
    """Class of the mapper called ``name``, or that "FILE.py:Name" names; a class is checked and
    returned.

    Raises:
        KeyError: no system of that name; the message lists the known ones.
        TypeError, ValueError, FileNotFoundError: the file, or the package that adds the system,
            cannot be loaded, or has no such system.
    """
    if not isinstance(name, str):
        check_system(name, name.__name__ if isinstance(name, type) else "system")
        return name if name in _all() else mapping_system(name)
    if name in SYSTEMS:
        return SYSTEMS[name]
    if name in _REGISTERED:
        return _REGISTERED[name]
    if is_code_file(name):
        source, class_name = read_code_file(name, _FILE)
        return system_of_source(source, class_name, name.rpartition(":")[0], code_folder(name))
    installed = _installed()
    if name in installed:
        return _of_package(installed[name])
    known = ", ".join(sorted(system_names()))
    raise UnknownNameError(f"no system {name!r}; known: {known}, or one in a file: FILE.py:Name")


def system_of_source(
    source: str, name: str, file: str = "system.py", folder: Path | None = None
) -> type[Mapper]:
    """The system ``name`` of a file's source (``module_of_source``). The seeding rules that the
    file registers are registered with it.

    Raises:
        ValueError: the source cannot be loaded, has no such class, or a system of this package has
            its name, title or settings; or it registers a rule under a name that is taken.
        TypeError: the class is not a system (``check_system``).
    """
    module = module_of_source(source, file, folder)
    mapper = vars(module).get(name)
    if mapper is None:
        own = [key for key, value in vars(module).items() if _is_own(value, module.__name__)]
        raise ArgumentError(
            f"{file} has no system {name!r}; it defines: {', '.join(own) or 'none'}"
        )
    check_system(mapper, file)
    register_rules_in(module, file)
    _add(name, mapper, file)
    return mapper


def system_of(config: SystemConfig) -> str:
    """Name of the system that settings belong to; that of its class, if it is in a file.

    Raises:
        TypeError: they are not the settings of a system that was loaded.
    """
    if type(config) not in _NAMES:
        raise KindError(
            f"expected the settings of a system ({', '.join(system_names())}), got "
            f"{type(config).__name__}; a class of your own is made known by @mapping_system"
        )
    return _NAMES[type(config)][0]


def system_class(config: SystemConfig) -> type[Mapper]:
    """Class of the mapper that settings belong to. Raises ``TypeError`` as ``system_of``."""
    system_of(config)
    return _NAMES[type(config)][1]


def know_system(mapper: Mapper) -> None:
    """Make the system of a mapper known by its settings, if it is not: it was defined in this
    process. Raises as ``mapping_system``."""
    if type(mapper.config) not in _NAMES:
        mapping_system(type(mapper))


def package_of(name: str) -> str:
    """Name and version of the installed package that adds a system; empty if none does."""
    extension = _installed().get(name) if name not in SYSTEMS else None
    return "" if extension is None else extension.package


def system_key(mapper: type[Mapper]) -> CodeKey:
    """The key of a system's code (``code_key``)."""
    key = code_key(mapper)
    parts = {name.replace("of the rule", "of the system"): part for name, part in key.parts.items()}
    return dataclasses.replace(key, parts=parts)


def make_mapper(
    config: SystemConfig,
    *,
    seeding: "str | SeedingRule | None" = None,
    device: torch.device | str = "cpu",
    loss: LossFunction | None = None,
    optimiser: UpdateFunction | None = None,
) -> Any:
    """A new mapper of the system that ``config`` belongs to; arguments as for ``Mapper``."""
    given = given_functions(loss, optimiser)
    return system_class(config)(config, seeding=seeding, device=device, **given)


def _installed() -> dict[str, Extension]:
    return extensions("systems", built_in=SYSTEMS)


def _of_package(extension: Extension) -> type[Mapper]:
    mapper = check_system(extension.load(), extension.in_words)
    _add(extension.name, mapper, extension.in_words)
    _REGISTERED[extension.name] = mapper
    return mapper


def _all() -> list[type[Mapper]]:
    return [mapper for _, mapper in _NAMES.values()]


def _is_own(value: Any, module: str) -> bool:
    return isinstance(value, type) and issubclass(value, Mapper) and value.__module__ == module


def _add(name: str, mapper: type[Mapper], origin: str) -> None:
    """Note whose settings these are.

    Raises:
        ValueError: a system of this package has the name or the title, or another system the
            settings.
    """
    titles = {built_in.description.title: other for other, built_in in SYSTEMS.items()}
    if name in SYSTEMS or mapper.description.title in titles:
        taken = f"name {name!r}" if name in SYSTEMS else f"title {mapper.description.title!r}"
        raise ArgumentError(
            f"{origin}: gsfusion_nb itself has a system of the {taken}; choose another"
        )
    other_name, other = _NAMES.get(mapper.config_type, (name, mapper))
    if other_name != name or (other is not mapper and other.__module__ != mapper.__module__):
        kind = mapper.config_type.__name__
        raise ArgumentError(
            f"{origin}: {kind} are the settings of the system {other_name!r}; give {name} a class "
            f"of its own: @dataclass(frozen=True, kw_only=True) class {name}Config({kind})"
        )
    _NAMES[mapper.config_type] = (name, mapper)
