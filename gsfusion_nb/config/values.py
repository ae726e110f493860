"""Changing, saving, comparing and explaining settings: frozen dataclasses of plain values or of
such dataclasses."""

import ast
import dataclasses
import functools
import inspect
import itertools
import math
import textwrap
import tomllib
import typing
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import field, is_dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, get_args, get_origin

from ..checks import check_name, check_number, check_positive, shown
from ..files import SequenceError, parse_json

C = TypeVar("C")


NOT_FOR_RULES = ("data", "seed", "seeding.rule", "seeding.options", "seeding.own_settings")
"""Settings that a seeding rule cannot bring: they are used before the mapper is made, or choose the
rule itself."""


def replace(config: C, **overrides: Any) -> C:
    """A copy of ``config`` with some fields changed; nested ones take a double underscore:
    ``tsdf__voxel_size_m``.

    In the settings of a system these count as set by the user: a seeding rule does not change them.
    """
    changes = nested(overrides, "__")
    return with_own_settings(_merge(config, changes, ""), leaves(changes))


def with_own_settings(config: C, names: Iterable[str]) -> C:
    """The settings of a system with more names in ``seeding.own_settings``; other settings are
    returned unchanged."""
    seeding: Any = getattr(config, "seeding", None)
    if not hasattr(seeding, "own_settings"):
        return config
    own = list(seeding.own_settings)
    for name in names:
        for_rules = not any(
            name == taken or name.startswith(f"{taken}.") for taken in NOT_FOR_RULES
        )
        if for_rules and name not in own:
            own.append(name)
    return _merge(config, {"seeding": {"own_settings": own}}, "")


def nested(values: Mapping[str, Any], separator: str) -> dict[str, Any]:
    """Values by flat names, such as ``tsdf.voxel_size_m``, as dictionaries in dictionaries."""
    tree: dict[str, Any] = {}
    for name, value in values.items():
        node = tree
        *groups, leaf = name.split(separator)
        for group in groups:
            node = node.setdefault(group, {})
        node[leaf] = value
    return tree


def from_dict(
    cls: type[C],
    values: dict[str, Any],
    *,
    start: C | None = None,
) -> C:
    """Build ``cls`` from nested dictionaries, as ``to_dict`` or ``config.json`` give them; unknown
    keys are refused.

    What ``values`` leaves out comes from ``start``, or from the defaults.

    Raises:
        ValueError: a value that no setting has, or a seeding rule in a file: no mapper executes
            code because a file of settings says so.
    """
    seeding = values.get("seeding")
    rule = seeding.get("rule") if isinstance(seeding, dict) else None
    if isinstance(rule, str) and ".py" in rule:
        raise ValueError(
            f"seeding.rule must be the name of a rule, got the file {shown(rule)}; where you trust "
            "it, give it to run_mapping or to a mapper (seeding=...)"
        )
    return _merge(cls() if start is None else start, values, "")


def from_run(cls: type[C], values: dict[str, Any]) -> C:
    """The settings of a run, from its files: what they leave out is what runs did before that
    setting existed.

    That is not always the default: a setting that came later may have a default that changes maps
    (``within``).
    """
    return from_dict(cls, values, start=_before(cls()))


def _before(settings: C) -> C:
    """``settings`` with the values that runs had before the settings existed, where a field names
    one."""
    changes = {}
    for f in dataclasses.fields(settings):  # pyright: ignore[reportArgumentType]
        value = getattr(settings, f.name)
        if dataclasses.is_dataclass(value):
            changes[f.name] = _before(value)
        elif "before" in f.metadata:
            changes[f.name] = f.metadata["before"]
    return dataclasses.replace(settings, **changes)  # pyright: ignore[reportArgumentType]


def to_dict(config: Any) -> dict[str, Any]:
    """Nested plain dictionaries of a config, ready for JSON."""
    return dataclasses.asdict(config)


def within(
    default: Any,
    low: float | int,
    high: float | int = math.inf,
    **more: Any,
) -> Any:
    """A field of settings whose numbers lie between ``low`` and ``high``, both allowed; ``more`` as
    for ``setting``."""
    return setting(default, range=(low, high), **more)


def positive(default: Any, **more: Any) -> Any:
    """A field of settings whose number is above 0; ``more`` as for ``setting``."""
    return setting(default, positive=True, **more)


def setting(default: Any, **metadata: Any) -> Any:
    """A field of settings.

    Args:
        default: Its default.
        metadata: ``before``: what a run did before the setting existed, where that is not the
            default (``from_run``).
    """
    return field(default=default, metadata=metadata)


def named(default: Any, names: Callable[[], Iterable[str]]) -> Any:
    """A field of options that is one of the names of a registry, or several; the help lists them.

    Args:
        default: Its default, or a function that returns it.
        names: Returns what the registry has; it may add a few words in brackets to a name.
    """
    given: dict[str, Any] = (
        {"default_factory": default} if callable(default) else {"default": default}
    )
    return field(**given, metadata={"names": names})


class Settings:
    """A group of settings. Values outside of the ranges that its fields declare are refused when it
    is made."""

    group: ClassVar[str] = ""

    def __init_subclass__(cls, group: str = ""):
        cls.group = group

    def __post_init__(self):
        check_kinds(self.group, self)


def check_kinds(group: str, config: Any) -> None:
    """Raise ``ValueError`` unless words are among those a field lists, whole numbers whole,
    switches booleans, and numbers in their range."""
    for f in dataclasses.fields(config):
        name = f"{group}.{f.name}".removeprefix(".")
        value = getattr(config, f.name)
        words = typing.get_args(f.type) if typing.get_origin(f.type) is typing.Literal else ()
        if words and value not in words:
            raise ValueError(f"{name} must be one of {', '.join(words)}, got {shown(value)}")
        for kind, wanted in ((int, "a whole number"), (bool, "True or False"), (str, "a text")):
            if f.type is kind and (
                not isinstance(value, kind) or isinstance(value, bool) != (kind is bool)
            ):
                raise ValueError(f"{name} must be {wanted}, got {shown(value)}")
        if (
            isinstance(f.type, type)
            and dataclasses.is_dataclass(f.type)
            and not isinstance(value, f.type)
        ):
            raise ValueError(f"{name} must be a group of settings, got {shown(value)}")
        if typing.get_origin(f.type) is dict and not isinstance(value, dict):
            raise ValueError(f"{name} must hold values by name, got {shown(value)}")
        for number in () if value is None else value if isinstance(value, tuple) else (value,):
            if "range" in f.metadata:
                check_number(name, number, *f.metadata["range"])
            elif "positive" in f.metadata:
                check_positive(name, number)


def _merge(config: Any, values: dict[str, Any], path: str) -> Any:
    known = {f.name for f in dataclasses.fields(config)}
    unknown = sorted(set(values) - known)
    if unknown:
        raise ValueError(
            f"{path.rstrip('.') or 'config'}: unknown keys {unknown}; known: {sorted(known)}"
        )
    changed = {}
    for name, value in values.items():
        old = getattr(config, name)
        nested = dataclasses.is_dataclass(old) and isinstance(value, dict)
        if nested:
            changed[name] = _merge(old, value, f"{path}{name}.")
        else:
            changed[name] = tuple(value) if isinstance(old, tuple) else value  # JSON has no tuples
    return dataclasses.replace(config, **changed)


@functools.cache
def read_packaged(path: Path) -> dict[str, Any]:
    """Values of a TOML file of this package, read once; the text "None" stands for no value, which
    TOML lacks."""
    return _with_none(tomllib.loads(path.read_text(encoding="utf-8")))


def _with_none(values: Any) -> Any:
    if isinstance(values, dict):
        return {name: _with_none(value) for name, value in values.items()}
    return None if values == "None" else values


MEASURED = "measured"
"""The fidelity of the defaults: what gave better results in our measurements."""


class Presets:
    """Settings of a system. The defaults of its dataclass are the fidelity "measured" on most data;
    ``presets.toml`` says what other fidelities and data sets change.

    Args:
        system: Its name.
        start: Its default settings.
    """

    def __init__(self, system: str, start: Any):
        tables = read_packaged(Path(__file__).with_name("presets.toml"))[system]
        self.start = start
        self.of_data: dict[str, dict[str, Any]] = tables["data"]
        """Preset -> the user's part in every fidelity: a seeding rule does not change it."""
        self.published: dict[str, Any] = tables["published"]
        """What all fidelities but "measured" have."""
        self.published_on: dict[str, dict[str, Any]] = tables.get("published_on", {})
        """Preset -> the user's part in these fidelities."""
        self.measured_on: dict[str, dict[str, Any]] = tables.get("measured_on", {})
        """Preset -> what "measured" has for this data only."""
        self.fidelities: dict[str, dict[str, Any]] = {MEASURED: {}} | tables["fidelity"]
        """Fidelity -> settings over ``published``."""
        self.of_code: dict[str, dict[str, Any]] = tables.get("code_on", {})
        """Preset -> a last layer of the fidelity "code"."""

    def make(
        self,
        preset: str,
        fidelity: str,
        overrides: dict[str, Any],
    ) -> Any:
        """The settings of a preset and a fidelity, with fields changed as for ``replace``.

        Raises:
            KeyError: unknown preset or fidelity. ValueError: unknown field.
        """
        check_name("preset", preset, self.of_data)
        check_name("fidelity", fidelity, self.fidelities)
        own = dict(self.fidelities[fidelity])
        like = self.fidelities.get(own.pop("like", ""), {})
        follows_paper = fidelity != MEASURED
        config = self.start
        for layer in (self.published if follows_paper else {}, like, own):
            config = _merge(config, layer, "")
        if follows_paper:
            config = replace(config, **self.published_on.get(preset, {}))
        else:
            config = _merge(config, self.measured_on.get(preset, {}), "")
        config = replace(config, **self.of_data[preset])
        if fidelity == "code":
            config = _merge(config, self.of_code.get(preset, {}), "")
        return replace(config, **overrides)

    @functools.cached_property
    def _values(self) -> dict[str, list[dict[str, Any]]]:
        """Fidelity -> values by dotted name for each preset."""
        return {f: [_results(self.make(p, f, {})) for p in self.of_data] for f in self.fidelities}

    def fidelity_of(self, config: Any) -> str:
        """The fidelity that ``config`` follows, with its exceptions: "paper", or "code, but
        optim.ssim_weight 0.0".

        Only the settings in which the fidelities differ count. Of equally close ones it is the
        first.
        """
        deciding = {
            key
            for same_data in zip(*self._values.values(), strict=True)
            for key in same_data[0]
            if any(v[key] != same_data[0][key] for v in same_data)
        }
        mine = {key: value for key, value in sorted(_results(config).items()) if key in deciding}
        exceptions = [
            (name, [f"{key} {value}" for key, value in mine.items() if value != v[key]])
            for name, variants in self._values.items()
            for v in variants
        ]
        closest, others = min(exceptions, key=lambda found: len(found[1]))
        return f"{closest}, but {', '.join(others)}" if others else closest


def _results(config: Any) -> dict[str, Any]:
    """The settings that results depend on, by dotted name: not which of them the user set."""
    values = leaves(to_dict(config))
    del values["seeding.own_settings"]
    return values


def leaves(
    values: Mapping[str, Any],
    path: str = "",
) -> dict[str, Any]:
    """Nested values by dotted name; the options of the seeding rule are one value."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        nested = isinstance(value, dict) and name != "options"
        found |= leaves(value, f"{path}{name}.") if nested else {path + name: value}
    return found


T = TypeVar("T")


EVERYDAY = (
    "system",
    "preset",
    "fidelity",
    "rule_options",
    "device",
    "data",
    "out",
    "reader",
    "resume",
    "evaluate",
    "sh_degree",
    "seed",
    "keyframe_every",
    "data.width",
    "data.stop",
    "data.stride",
    "data.depth_max_m",
    "data.hold_out_every",
    "tsdf.voxel_size_m",
    "tsdf.far_m",
    "seeding.rule",
    "seeding.quadtree_threshold",
    "tracking.poses",
    "tracking.back_end",
    "optim.global_iterations",
    "optim.refine_poses",
    "optim.fit_exposure",
    "final.passes",
)
"""The options that people change, by dotted name, of all systems. ``--help`` of a command with
settings shows only these, ``--help-all`` every one."""


def parse_options(
    options: type[T],
    *,
    prog: str,
    arguments: list[str],
    everyday: Collection[str] = (),
) -> T:
    """``tyro.cli`` with the texts under the fields as help.

    Args:
        options: Dataclass of the options; the text under a field is its help.
        prog: Name of the command in the help.
        arguments: What the user typed after it.
        everyday: Dotted names of the options that ``--help`` shows, all by default; ``--help-all``
            shows every one.
    """
    import tyro

    _explain(options)
    if "--help-all" in arguments:
        arguments = ["--help"]
    elif everyday and {"-h", "--help"} & set(arguments):
        options = _only(everyday, options)
        options.__doc__ = f"{(options.__doc__ or '').strip()} --help-all shows every option."
    return tyro.cli(options, prog=prog, args=arguments)


def named_values(texts: Iterable[str]) -> dict[str, Any]:
    """``name=value`` texts as a dictionary of numbers, True or False, and words; a dash in a name
    is an underscore.

    Raises:
        ValueError: a text without "=".
    """
    values: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise ValueError(f"expected an option as name=value, got {shown(text)}")
        values[name.strip().replace("-", "_")] = parse_value(value.strip())
    return values


def parse_value(text: str) -> Any:
    """A number, True or False, or the text itself if it is neither."""
    try:
        return parse_json(
            text.lower() if text.lower() in ("true", "false") else text, text, "a value"
        )
    except SequenceError:
        return text


def _only(
    names: Collection[str],
    options: type[T],
    default: Any = None,
    path: str = "",
) -> type[T]:
    """A dataclass for a help text: the fields of ``options`` that have these dotted names, with
    their defaults."""
    hints = typing.get_type_hints(options, include_extras=True)
    fields = []
    for f in dataclasses.fields(options):  # pyright: ignore[reportArgumentType]
        value = f.default if default is None else getattr(default, f.name)
        if value is dataclasses.MISSING and f.default_factory is not dataclasses.MISSING:
            value = f.default_factory()
        kind = hints[f.name]
        if is_dataclass(value):
            # the settings of a system are at the top
            below = path if f.name == "config" else f"{path}{f.name}."
            if any(name.startswith(below) for name in names):
                group = _only(names, type(value), value, below)
                kind = (
                    Annotated[(group, *get_args(kind)[1:])]
                    if get_origin(kind) is Annotated
                    else group
                )
                fields.append((f.name, kind, field(default_factory=group)))
        elif path + f.name in names:
            fields.append((f.name, kind, field(default_factory=lambda value=value: value)))
    reduced: Any = dataclasses.make_dataclass(options.__name__, fields, kw_only=True)
    reduced.__doc__ = options.__doc__
    return reduced


def _explain(options: type) -> None:
    """Attach the explanations to the fields of a dataclass, of its bases, and of the dataclasses in
    it."""
    for base in options.__mro__:
        if "__dataclass_fields__" in vars(base):
            _explain_own_fields(base)


@functools.cache
def _explain_own_fields(cls: type) -> None:
    import tyro

    texts = _explanations(cls)
    fields = {f.name: f for f in dataclasses.fields(cls)}
    for name, kind in [(n, k) for n, k in inspect.get_annotations(cls).items() if n in fields]:
        plain, *marks = get_args(kind) if get_origin(kind) is Annotated else (kind,)
        if is_dataclass(plain):
            _explain(plain)  # pyright: ignore[reportArgumentType]
        elif name in texts:
            metavar = next((mark.metavar for mark in marks if hasattr(mark, "metavar")), None)
            if tyro.conf.Positional in marks and not metavar:
                metavar = f"[{name.upper()}]" if hasattr(cls, name) else name.upper()
            text = texts[name]
            if "names" in fields[name].metadata:
                text = f"{text} Known: {', '.join(fields[name].metadata['names']())}."
            explained = tyro.conf.arg(help=text, metavar=metavar, help_behavior_hint=_default)
            cls.__annotations__[name] = Annotated[(plain, *marks, explained)]


def _default(value: str) -> str:
    """The default value after an explanation; an empty one says nothing, and the explanation says
    what it means."""
    return "" if value in ("", "''", "{}") else f"(default: {value})"


def _explanations(cls: type) -> dict[str, str]:
    """The text under each field of a dataclass, on one line."""
    try:
        source: Any = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
    except (OSError, TypeError):  # made at run time, such as the options of one system
        return {}
    return {
        each.target.id: " ".join(text.value.value.split())  # pyright: ignore
        for each, text in itertools.pairwise(source.body)
        if isinstance(each, ast.AnnAssign)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
    }
