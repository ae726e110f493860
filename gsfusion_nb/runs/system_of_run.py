"""The system of a run. Where it came from a file, it is somebody else's code until the user names
it."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..checks import shown
from ..code_keys.key import differing
from ..errors import SequenceError, UnknownNameError
from ..files import write_file
from ..mapping import SYSTEMS, Mapper, get_system, package_of, system_of
from ..mapping.systems import system_key, system_of_source
from ..seeding.code_files import (
    SYSTEM_MODULES,
    beside_sources,
    code_folder,
    file_source,
    is_code_file,
    read_code_file,
)
from ..seeding.named_code import SystemNotNamedError
from .run_folder import SYSTEM

_PARTS: dict[type[Mapper], dict[str, str]] = {}
"""Class of a system -> ``CodeKey.parts`` when a run of it began here."""


def about_system(mapper: Mapper) -> dict[str, Any]:
    """What a run's files say of its system: its name, whether it came from a file, which installed
    package adds it, and whether its Gaussians alone are no picture."""
    name = system_of(mapper.config)
    about: dict[str, Any] = {"system": name}
    if file_source(type(mapper)):
        about["system_from_file"] = True
    elif package := package_of(name):
        about["system_package"] = package
    about["drawn_over_volume"] = mapper.description.needs_volume_to_render
    return about


def code_of_system(mapper: Mapper) -> dict[str, str]:
    """Part -> hash or version of what a system is made of that is not of this package; as it was
    when this was first asked for."""
    kind = type(mapper)
    if kind in SYSTEMS.values():
        return {}
    if kind not in _PARTS:
        _PARTS[kind] = dict(system_key(kind).parts)
    return _PARTS[kind]


def write_system(mapper: Mapper, folder: Path) -> None:
    """Write the source of a system that came from a file, with the modules that it imports from
    beside it; it is needed to score, to export and to continue the run."""
    kind = type(mapper)
    code_of_system(mapper)
    if source := file_source(kind):
        write_file(folder / SYSTEM, source)
        for name, content in beside_sources(kind).items():
            write_file(folder / SYSTEM_MODULES / name, content)


def system_of_run(
    folder: Path,
    document: Mapping[str, Any],
    system: "str | type[Mapper] | None" = None,
    how: Callable[[str], str] = repr,
) -> type[Mapper]:
    """The system of a finished or interrupted run.

    Args:
        folder: Of the run.
        document: What its files say of it (``about_system``).
        system: Named by the caller: "FILE.py:Name" with the content of the file in the run's
            folder, or the class.
        how: A text by which a caller in Python names "FILE.py:Name".

    Raises:
        SystemNotNamedError: it came from a file, and none is named. Nothing was executed.
        SequenceError: another one is named, or it is not known here; the message has its name, and
            how to give it.
    """
    name = str(document.get("system", "gsfusion"))
    if isinstance(system, type):
        return get_system(system)
    if document.get("system_from_file"):
        return _of_file(folder, name, system, how)
    if system is not None and system != name:
        raise SequenceError(
            f"{folder} was mapped by the system {shown(name)}, not by {shown(system)}; leave out "
            "the system, or map again with the other one"
        )
    if is_code_file(name):
        raise SequenceError(f"{folder} does not say by which system it was mapped: {shown(name)}")
    try:
        return get_system(name)
    except UnknownNameError:
        package = document.get("system_package")
        where = (
            f"install the package that adds it, which was {shown(package)}"
            if package
            else "define it with @mapping_system, and repeat this in Python"
        )
        raise SequenceError(
            f"{folder} was mapped by the system {shown(name)}, which is not known here; {where}"
        ) from None


def _of_file(
    folder: Path, name: str, system: str | None, how: Callable[[str], str]
) -> type[Mapper]:
    own = f"{folder / SYSTEM}:{name}"
    if not (folder / SYSTEM).is_file():
        raise SequenceError(
            f"{folder} was mapped by the system {shown(name)} in a file, and its source, {SYSTEM}, "
            "is no longer in that folder; put it back"
        )
    source, _ = read_code_file(own, "a mapping system")
    if system is None:
        raise SystemNotNamedError(folder, [own], how(own))
    if not is_code_file(system) or read_code_file(system, "a mapping system") != (source, name):
        raise SequenceError(
            f"{system} is not the system with which the run in {folder} began: the run's own is "
            f"{own}; name that one, or map again with the other one"
        )
    return system_of_source(source, name, system.rpartition(":")[0], code_folder(system))


def refuse_other_system(folder: Path, mapper: Mapper, parts: Mapping[str, str]) -> None:
    """Raise ``SequenceError`` if the code of a system is not the one with which its run began.

    Args:
        folder: Of the run.
        mapper: The mapper that is to continue it.
        parts: ``code_of_system`` of the run.
    """
    if changes := differing(parts, code_of_system(mapper)):
        raise SequenceError(
            f"the system {system_of(mapper.config)!r} is not as it was when {folder} began; "
            f"different: {changes}. Restore it, or map again into a new folder"
        )
