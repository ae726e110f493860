"""The runs of several variants on one recording, as a command asks for them."""

import contextlib
import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..checks import check_device, check_whole
from ..config import presets
from ..config.options import named, named_values
from ..errors import ArgumentError
from ..mapping import SYSTEMS
from ..seeding import check_options, get_rule
from ..seeding.code_files import code_folder, file_source, is_code_file, read_code_file
from .command import WhereOptions
from .map_scene import Entry
from .spec import Budget, RunSpec, system_fields
from .training_code import training_code

Values = Mapping[str, Any]
"""Name -> value: "system", "fidelity", "loss", "optimiser", "seeding.rule", an option of the rule
as "rule.<name>", or a setting."""

RULE = "seeding.rule"
OPTION = "rule."
"""The setting whose values are rules, and the beginning of the names of a rule's options."""


def fidelity_names() -> list[str]:
    """Fidelities of the systems of this package; a system has some of them."""
    fidelities = (mapper.description.fidelities for mapper in SYSTEMS.values())
    return list(dict.fromkeys(itertools.chain.from_iterable(fidelities)))


@dataclass(frozen=True, kw_only=True)
class RecordingOptions(WhereOptions):
    """What is mapped."""

    set: tuple[str, ...] = ()
    """Settings of all runs: --set data.width=320 data.height=240 seeding.rule=uniform
    rule.fraction=0.1."""
    seeds: int = 1
    """Number of seeds: 0, 1, and so on."""
    preset: str = named("", presets)
    """Settings for a data set. Where none is given: room for the built-in scene, otherwise
    replica."""
    reader: tuple[str, ...] = ()
    """Options of the layout's reader, name=value: n_frames=60 (room)."""
    fidelity: str = named("", fidelity_names)
    """What all runs follow where paper and released code differ, unless a variant names another:
    one of the system's fidelities, such as paper or code. Default: the settings of this
    package."""
    device: str = "cpu"
    """Device of the maps: cpu, or cuda."""
    loss: str = ""
    """A loss in place of the systems' own: FILE.py:name, which is executed (docs/api.md)."""
    optimiser: str = ""
    """An optimiser in place of the systems' own: FILE.py:name, which is executed."""


def output_folder(options: RecordingOptions, name: str, data: str) -> Path:
    """Where the results go: ``--out``, else a folder in runs/ with the names of the command and of
    the recording."""
    return Path(options.out or f"runs/{name}-{Path(data).name}").expanduser()


def recording_specs(
    variants: Mapping[str, Values],
    options: RecordingOptions,
    data: str,
    *,
    common: Values | None = None,
    **fields: Any,
) -> list[RunSpec]:
    """A run of each variant and seed on one recording, checked.

    Args:
        variants: Label -> what is set.
        options: What was asked for; its settings and options of the reader are set in all runs.
        data: Folder of the recording, or "room".
        common: What else is set in all runs, unless ``options`` sets it.
        fields: Other fields of ``RunSpec``.

    Raises:
        ValueError, KeyError, TypeError: a setting that does not exist, or a value that is refused.
    """
    check_whole("seeds", options.seeds, 1)
    place = data if data == "room" else str(Path(data).expanduser().resolve())
    if not options.dask:  # its workers may have what this machine lacks
        check_device("--device", options.device)
    asked = {name: getattr(options, name) for name in ("fidelity", "loss", "optimiser")}
    asked = {name: value for name, value in asked.items() if value}
    shared = {**(common or {}), **asked, **named_values(options.set)}
    reader = named_values(options.reader)
    own = {"preset": options.preset, "device": options.device}
    fields = {"scene": Path(data).name, "data": place, **own} | fields
    fields["reader"] = {**fields.get("reader", {}), **reader}
    specs = [spec_with({**shared, **values}, label, **fields) for label, values in variants.items()]
    for spec in specs:
        with _said_of(spec.system_name):
            spec.config()
        check_options(spec.found_rule(), spec.options)
    Entry(spec=specs[0]).opened()
    specs = [spec.with_code(spec.found_rule()) for spec in specs]
    return [dataclasses.replace(spec, seed=seed) for spec in specs for seed in range(options.seeds)]


@contextlib.contextmanager
def _said_of(system: str) -> Iterator[None]:
    """A block whose errors about settings name the system that refuses them."""
    try:
        yield
    except ValueError as e:
        raise ArgumentError(f"system {system}: {e}") from None


def check_one_process(options: WhereOptions, study: str) -> None:
    """Raise ``ValueError`` if a study that runs in one process is to run in several."""
    if options.jobs > 1 or options.dask:
        raise ArgumentError(f"study {study} runs in one process; leave out --jobs and --dask")


def labels_with(only: str, labels: Iterable[str], what: str) -> list[str]:
    """The labels that contain ``only``, capital letters or not.

    Args:
        only: Of the option --only; "" for all labels.
        labels: Those to choose from.
        what: What a label names, for the error.

    Raises:
        ValueError: no label does.
    """
    known = list(labels)
    chosen = [label for label in known if only.lower() in label.lower()]
    if not chosen:
        raise ArgumentError(
            f"--only: no {what}'s name contains {only!r}; there are {', '.join(known)}"
        )
    return chosen


def ran_under(specs: Sequence[RunSpec]) -> str:
    """What all runs have in common, in a sentence: system, preset, fidelity, settings, options of
    rule and reader.

    Args:
        specs: At least one run.
    """
    first, *others = map(_values_of, specs)
    shared = {
        name: value
        for name, value in first.items()
        if all((name, value) in o.items() for o in others)
    }
    return f"All runs have {', '.join(f'{name} {value}' for name, value in shared.items())}."


def _values_of(spec: RunSpec) -> dict[str, Any]:
    """Everything that a run sets, by name; a setting that nobody named is that of the preset and
    the fidelity."""
    fidelity = spec.fidelity or next(iter(spec.found_system().description.fidelities), "")
    names = {"system": spec.system_name, "preset": spec.preset} | (
        {"fidelity": fidelity} if fidelity else {}
    )
    names |= {"device": spec.device} if spec.device != "cpu" else {}
    names |= {kind: code["name"] for kind, code in spec.training.items()}
    options = {f"{OPTION}{name}": value for name, value in spec.options.items()}
    reader = {f"reader {name}": value for name, value in spec.reader.items()}
    return names | dict(spec.settings) | options | reader


def spec_with(values: Values, label: str, **fields: Any) -> RunSpec:
    """A run with some values set; its rule and the options of the rule are those of its system
    otherwise.

    Args:
        values: What is set.
        label: Name in tables.
        fields: Other fields of ``RunSpec``.

    Raises:
        ValueError: the file of a rule, a loss or an optimiser cannot be read.
        FileNotFoundError: it does not exist.
    """
    values = dict(values)
    system = values.pop("system", "gsfusion")
    fidelity = values.pop("fidelity", "")
    training = {kind: values.pop(kind, "") for kind in ("loss", "optimiser")}
    base = RunSpec(
        rule="",
        label=label,
        training=training_code(**training),
        **system_fields(system),
        fidelity=fidelity,
        budget=Budget(steps="own"),
        **fields,
    )
    mapper = base.found_system()
    fidelities = mapper.description.fidelities
    if fidelity and fidelity not in fidelities:
        raise ArgumentError(
            f"system {base.system_name} has no fidelity {fidelity!r}; it has: "
            f"{', '.join(fidelities) or 'none'}"
        )
    own = mapper.preset(base.preset, **({"fidelity": fidelity} if fidelity else {})).seeding
    rule = values.pop(RULE, own.rule)
    options = dict(own.options) if rule == own.rule else {}
    options |= {
        name.removeprefix(OPTION): v for name, v in values.items() if name.startswith(OPTION)
    }
    settings = {name: v for name, v in values.items() if not name.startswith(OPTION)}
    source = read_code_file(rule)[0] if is_code_file(rule) else ""
    folder = str(code_folder(rule)) if source else ""
    if not source and base.system_source and file_source(get_rule(rule)) == base.system_source:
        rule = f"{base.system.rpartition(':')[0]}:{rule}"  # it is in the file of the system
        source = base.system_source
        folder = base.system_folder
    return dataclasses.replace(
        base, rule=rule, options=options, settings=settings, rule_source=source, rule_folder=folder
    )
