"""What one run is, as plain values: rule, options, scene, seed, budget, settings; and its key."""

import dataclasses
import functools
import json
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ..backends import MINE, BackendUnavailable, chosen
from ..checks import check_number, shown
from ..config import to_dict
from ..config.values import check_kinds, within
from ..data import OpenedSequence, open_sequence, sequence_fingerprint
from ..errors import ArgumentError
from ..mapping import Mapper, get_system, system_of
from ..mapping.systems import system_of_source
from ..seeding import Option, SeedingRule, get_rule
from ..seeding.code_files import file_of, file_source
from ..seeding.rule_code import rule_of_source
from .program import look_at_program_again, own_code, run_key
from .schedule import with_settings
from .training_code import TrainingCode, training_key

ONLY_NOW = "only in this command"
"""Part of the code of a run whose code cannot be hashed, so that no other run has the same key."""


@dataclass(frozen=True, kw_only=True)
class Budget:
    """What every rule of a comparison may spend."""

    steps: Literal["equal", "own"] = "equal"
    """Gradient steps. "equal": the same fixed schedule for every rule; "own": keyframes, and so the
    number of steps, follow from the seeds of the rule, as published."""
    gaussians: int | None = None
    """Gaussians in the final map: one numeric option of each rule is tuned until it has this many.
    None: as many as the rule makes."""
    tolerance: float | int = within(0.05, 0.001, 0.5)
    """Largest relative deviation from ``gaussians``."""

    def __post_init__(self):
        check_kinds("budget", self)
        if self.gaussians is not None:
            check_number("budget.gaussians", self.gaussians, 1)
            if not isinstance(self.gaussians, int):
                raise ArgumentError(
                    f"budget.gaussians must be a whole number, got {shown(self.gaussians)}"
                )

    def __str__(self) -> str:
        size = "own size" if self.gaussians is None else f"{self.gaussians:,} Gaussians"
        return f"{size}, {self.steps} steps"


@dataclass(frozen=True, kw_only=True)
class RunSpec:
    """One run of the lab. Everything that decides its result is in here, as plain values that JSON
    can hold."""

    rule: str
    """Name of a registered seeding rule, or "FILE.py:name"."""
    label: str = ""
    """Name in tables; made from the rule's name and its options if empty."""
    options: Mapping[str, Option] = field(default_factory=dict)
    """Keyword arguments of the rule."""
    scene: str = "room"
    """Name of the scene in tables."""
    data: str = ""
    """Folder of the sequence, or "room"; ``scene`` if empty."""
    reader: Mapping[str, Option] = field(default_factory=dict)
    """Options for opening the data: format, and those of the layout's reader, such as
    ``n_frames``."""
    seed: int = 0
    """Seed of all random numbers."""
    budget: Budget = field(default_factory=Budget)
    """What the run may spend."""
    system: str = "gsfusion"
    """Name of the mapping system, or "FILE.py:Name"."""
    system_source: str = ""
    """Source of the file that the system comes from; empty for one that is known by its name."""
    system_folder: str = ""
    """Folder of that file, where the modules are that it imports from beside it."""
    preset: str = ""
    """Settings published for a data set; "room" for the built-in scene and "replica" for others if
    empty."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings that differ from the preset, by dotted name: ``{"tsdf.voxel_size_m": 0.02}``."""
    size_option: str = ""
    """Option of the rule, or dotted setting, that is tuned to reach ``budget.gaussians``; the
    rule's own if empty. "thin": a random share of the seeds is kept instead."""
    size_range: tuple[float | int, float | int] | None = None
    """Smallest and largest value of ``size_option``; the usual range if None."""
    keep_share: float | int = 1.0
    """Share of the rule's seeds that is kept, drawn at random; 1 keeps all."""
    rule_source: str = ""
    """Source of the file that the rule comes from; empty for a rule of this package."""
    rule_folder: str = ""
    """Folder of that file, where the modules are that it imports from beside it; empty: there are
    none."""
    training: TrainingCode = field(default_factory=dict)
    """Loss and optimiser in place of the system's own (``training_code``)."""
    code: Mapping[str, str] | None = None
    """What decides what the rule does, and a system, loss or optimiser that is not of this package:
    part -> its hash or version (``CodeKey.parts``), with the files that the rule's options name.
    Found when the key is asked for if None."""
    not_kept: str = ""
    """Why no later command can use the result of this run; empty if it can."""
    data_hash: str = ""
    """``sequence_fingerprint`` of a sequence that was opened by the caller; otherwise empty."""
    device: str = "cpu"
    """Device of the maps."""
    fidelity: str = ""
    """What to follow where paper and released code differ, one of the system's ``fidelities``; its
    default if empty."""
    online: bool = False
    """Score the views also before the optimisation after the scan, and give frames per second."""

    def __post_init__(self):
        plain = {
            name: str(value) if isinstance(value, Path) else value
            for name, value in self.options.items()
        }
        object.__setattr__(self, "options", plain)
        object.__setattr__(self, "label", self.label or label_of(self.rule_name, self.options))
        object.__setattr__(self, "data", self.data or self.scene)
        object.__setattr__(
            self, "preset", self.preset or ("room" if self.data == "room" else "replica")
        )
        check_number("seed", self.seed, 0)
        check_number("keep_share", self.keep_share, 1e-6, 1)
        if self.size_range is not None and not 0 < self.size_range[0] < self.size_range[1]:
            size_text = shown(list(self.size_range))
            raise ArgumentError(
                f"size_range must be smallest and largest, both above 0, got {size_text}"
            )

    @property
    def rule_name(self) -> str:
        """Name of the rule, without the file that it comes from."""
        return self.rule.rpartition(":")[2]

    @property
    def system_name(self) -> str:
        """Name of the system, without the file that it comes from."""
        return self.system.rpartition(":")[2]

    def found_system(self) -> type[Mapper]:
        """Class of the mapper that the run names.

        Raises:
            KeyError: no such system. ValueError, TypeError: the source of the system cannot be
                loaded, or has no such system.
        """
        if not self.system_source:
            return get_system(self.system)
        place, folder = _place_of(self.system, self.system_folder)
        return system_of_source(self.system_source, self.system_name, place, folder)

    def config(self) -> Any:
        """The settings of the mapper, before the budget changes any.

        A rule that brings settings with it does not change those in ``settings``.

        Raises:
            KeyError: unknown system or preset. ValueError: a setting that does not exist, or has an
                invalid value.
        """
        base = self.found_system().preset(
            self.preset, **({"fidelity": self.fidelity} if self.fidelity else {})
        )
        settings = {name.replace("-", "_"): value for name, value in self.settings.items()}
        own = [*base.seeding.own_settings, *settings.pop("seeding.own_settings", ()), *settings]
        rule = {
            "seeding.rule": self.rule_name,
            "seeding.options": dict(self.options),
            "seed": self.seed,
        }
        return with_settings(base, settings | rule | {"seeding.own_settings": own})

    def opened(self) -> OpenedSequence:
        """The frames.

        Raises:
            SequenceError: they cannot be read.
        """
        reader: dict[str, Any] = dict(self.reader)
        return open_sequence(self.data, data=self.config().data, **reader)

    @functools.cached_property
    def content(self) -> str:
        """``sequence_fingerprint`` of the frames when this was first asked for; or why they cannot
        be opened."""
        if self.data_hash:
            return self.data_hash
        text = json.dumps(
            [self.data, dict(self.reader), to_dict(self.config())["data"]],
            sort_keys=True,
        )
        if text not in _seen:
            try:
                _seen[text] = sequence_fingerprint(self.opened())
            except (
                Exception
            ) as e:  # a reader of other people may raise anything; the run fails with it
                _seen[text] = f"{type(e).__name__}: {e}"
        return _seen[text]

    @functools.cached_property
    def key(self) -> str:
        """``run_key`` of data, settings, rule, options, seed, budget and program: equal keys mean
        equal results.

        Raises:
            BackendUnavailable: on the backend "mine", whose functions are no part of the program.
        """
        if chosen() == MINE:
            raise BackendUnavailable(
                "the lab keeps its results and cannot see when a learner's function changes; "
                'use it outside `with use_backend("mine")`'
            )
        parts = self.to_json()
        for name in (
            "label",
            "scene",
            "data",
            "rule",
            "preset",
            "fidelity",
            "settings",
            "rule_source",
            "rule_folder",
            "system_source",
            "system_folder",
            "training",
        ):
            parts.pop(name)  # names, and what the settings and the code say
        parts["system"] = self.system_name
        parts |= self._code()
        return run_key(
            **parts,
            config=to_dict(self.config()),
            content=self.content,
            backend=chosen(),
        )

    def found_rule(self) -> SeedingRule:
        """The rule that the run names.

        Raises:
            KeyError: no such rule. ValueError: the source of the rule cannot be loaded.
        """
        if not self.rule_source:
            if self.system_source:
                self.found_system()  # its file may register the rule
            return get_rule(self.rule)
        place, folder = _place_of(self.rule, self.rule_folder)
        return rule_of_source(self.rule_source, self.rule_name, place, folder)

    def with_code(self, rule: SeedingRule) -> "RunSpec":
        """The run with what its code is now: ``code``, and ``not_kept``.

        Raises:
            FileNotFoundError: an option names a file that does not exist. KeyError: no such system.
        """
        code = own_code(rule, self.options, self.found_system())
        training_parts, reason = training_key(self.training)
        code["code"] |= training_parts
        code["not_kept"] = code["not_kept"] or reason
        if code["not_kept"]:
            code["code"][ONLY_NOW] = uuid.uuid4().hex
        return dataclasses.replace(self, **code)

    def _code(self) -> dict[str, Any]:
        if self.code is not None:
            return {}
        try:
            spec = self.with_code(self.found_rule())
        except (KeyError, ValueError, TypeError, OSError) as e:  # the run fails with it
            return {"code": f"{type(e).__name__}: {e}"}
        return {"code": dict(spec.code or {}), "not_kept": spec.not_kept}

    def to_json(self) -> dict[str, Any]:
        """The run as plain values."""
        return json.loads(json.dumps(dataclasses.asdict(self)))

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "RunSpec":
        """The run that ``to_json`` gave.

        Raises:
            ValueError, TypeError, KeyError: ``values`` are not those of a run.
        """
        size_range = values.get("size_range")
        return cls(
            **{
                **values,
                "budget": Budget(**values.get("budget", {})),
                "size_range": None
                if size_range is None
                else (float(size_range[0]), float(size_range[1])),
            }
        )


def _place_of(text: str, folder: str) -> tuple[str, Path | None]:
    """The file of "FILE.py:name", in the folder where the modules beside it are; and that
    folder."""
    file = text.rpartition(":")[0]
    if not folder:
        return file, None
    return str(Path(folder) / Path(file).name), Path(folder)


def system_fields(system: str | type[Mapper]) -> dict[str, str]:
    """The fields of a run that say which system maps: by its name, "FILE.py:Name" or class.

    Raises:
        KeyError, ValueError, TypeError, FileNotFoundError: as for ``get_system``.
    """
    mapper = get_system(system)
    name = system if isinstance(system, str) else system_of(mapper.preset("room"))
    if not file_source(mapper):
        return {"system": name}
    file, folder = file_of(mapper)
    return {
        "system": f"{file}:{name.rpartition(':')[2]}",
        "system_source": file_source(mapper),
        "system_folder": "" if folder is None else str(folder),
    }


def label_of(rule: str, options: Mapping[str, Option]) -> str:
    """Name of a rule with options in tables: "uniform fraction=0.1"."""
    return " ".join(
        [rule, *(f"{k}={v:g}" if isinstance(v, float) else f"{k}={v}" for k, v in options.items())]
    )


_seen: dict[str, str] = {}
"""Data, options of the reader and settings -> ``sequence_fingerprint``, so that many runs look at
them once."""


def look_again() -> None:
    """Forget what the data and the program are: whoever asks for them next looks at the files
    anew."""
    _seen.clear()
    look_at_program_again()
