"""Go on in the map of a finished run with another recording: the mapper, its settings, and what
cannot go together."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..config import DataConfig, SystemConfig, from_run, replace, to_dict
from ..config.values import leaves
from ..errors import ArgumentError, SequenceError, reason_of
from ..files import parsing, read_object
from ..gaussians.columns import PARAMETERS
from ..mapping import Mapper, make_mapper, system_of
from ..mapping.systems import system_class
from ..mapping.usual_torch import in_usual_torch
from ..seeding import SeedingRule, rule_name
from ..seeding.code_files import is_code_file
from ..tracking import PLACES, read_places
from ..types import Camera
from .map_state import STATE, map_state, read_map_state
from .run_folder import METRICS
from .sound_state import check_same
from .stored_map import CONFIG, read_gaussians
from .system_of_run import system_of_run

GAP = 1000
"""Numbers between the last frame of the earlier run, counted back from 0, and the first new one."""

_MAP_GROUPS = ("tsdf", "discs", "base", "sh_degree")
"""Settings that say what a map is: they stay those of the run that began it."""


@dataclass(frozen=True, kw_only=True)
class Parent:
    """The run in whose map another recording goes on."""

    folder: Path
    system: str
    config: Any
    """Its settings."""
    document: dict[str, Any]
    """Its config.json."""
    hashes: dict[str, str]
    """SHA-256 of its maps, by metrics.json."""

    @property
    def as_json(self) -> dict[str, Any]:
        """How the new run names it."""
        return {"run": str(self.folder), "sha256": self.hashes}


def named_system(
    config: SystemConfig | str | None, system: str | type[Mapper]
) -> str | type[Mapper] | None:
    """The system that a run in the map of another was given; None: that of the other."""
    if isinstance(config, SystemConfig):
        return system_class(config)
    return None if system == "gsfusion" else system


def check_is_run(folder: Path | str) -> None:
    """Raise ``FileNotFoundError`` unless ``folder`` is one."""
    if not Path(folder).expanduser().is_dir():
        raise FileNotFoundError(f"{folder} does not exist; expected the folder of a finished run")


def read_parent(folder: Path | str, system: "str | type[Mapper] | None" = None) -> Parent:
    """The run in ``folder``; only its settings and numbers are read.

    Args:
        folder: Of the run.
        system: "FILE.py:Name" of a run whose system came from a file, or the class of the system
            that goes on.

    Raises:
        SystemNotNamedError: the run's system came from a file, and ``system`` names none.
        FileNotFoundError: no such run, or one of a version that did not keep its state.
        ValueError: a file is damaged.
    """
    path = Path(folder).expanduser().resolve()
    check_is_run(folder)
    file = path / CONFIG
    document = read_object(file, "the settings of a run", objects=("source", "config"))
    name = str(document.get("system", "gsfusion"))
    if isinstance(system, type) and (own := system_of(system.config_type())) != name:
        raise ArgumentError(
            f"{path} was mapped with the system {name}; {own} cannot go on in its map"
        )
    mapper = system_of_run(
        path, document, system, lambda own: f"run_mapping(..., onto=..., system={own!r})"
    )
    with parsing(file, "the settings of a run"):
        config = from_run(mapper.config_type, with_default_rule(document["config"]))
    for name in (PLACES, STATE):
        if not (path / name).exists():
            raise FileNotFoundError(
                f"{path / name} does not exist, without which no recording can go on in the map; "
                "the run is from an older version, or it mapped no frame: map its recording again"
            )
    numbers = read_object(path / METRICS, "the numbers of a run")
    hashes = numbers.get("sha256")
    with parsing(path / METRICS, "the numbers of a run"):
        if not isinstance(hashes, dict):
            raise ArgumentError("it has no hashes of maps")
        hashes = {str(name): str(digest) for name, digest in hashes.items()}
    return Parent(folder=path, system=name, config=config, document=document, hashes=hashes)


def with_default_rule(values: dict[str, Any]) -> dict[str, Any]:
    """Stored settings without the name of a rule in a file, which nobody named here."""
    seeding = values.get("seeding")
    if not isinstance(seeding, dict):
        return values
    rule = seeding.get("rule")
    if not isinstance(rule, str) or not is_code_file(rule):
        return values
    return {**values, "seeding": {**seeding, "rule": rule.rpartition(":")[2]}}


def settings_onto(config: SystemConfig) -> Any:
    """Settings of a run in the map of another: those of that run, with tracked poses and landmarks,
    and all frames of the new recording."""
    fresh = DataConfig()
    others = {
        name: getattr(fresh, name)
        for name in ("start", "stop", "stride", "align_held_out", "repair")
    }
    data = dataclasses.replace(config.data, **others)
    config = dataclasses.replace(config, data=data)
    return replace(
        config,
        tracking__poses="tracked",
        tracking__landmarks=True,
        tracking__back_end=False,
    )


def check_together(parent: Parent, config: SystemConfig) -> None:
    """Raise ``ValueError`` if a run with these settings cannot go on in the map of ``parent``."""
    mine = leaves(to_dict(config))
    theirs = leaves(to_dict(parent.config))
    others = [
        f"{setting} {theirs[setting]}, not {mine[setting]}"
        for setting in theirs
        if setting.partition(".")[0] in _MAP_GROUPS and mine[setting] != theirs[setting]
    ]
    if others:
        raise ArgumentError(
            f"the map of {parent.folder} was made with {', '.join(others)}; these settings are "
            "part of the map and stay"
        )
    if config.tracking.back_end:
        raise ArgumentError(
            "tracking.back_end cannot be used in the map of another run: a loop would move its "
            "frames, which the run does not keep; leave it out"
        )


@in_usual_torch
def mapper_onto(
    parent: Parent,
    config: SystemConfig,
    camera: Camera | None = None,
    *,
    seeding: "str | SeedingRule | None" = None,
    device: torch.device | str = "cpu",
    **given: Any,
) -> Mapper:
    """A mapper with the map of a finished run, in which it looks for the camera first.

    Args:
        parent: The run.
        config: Settings of the mapper (``settings_onto``).
        camera: Of the new recording; None: that of its first frame.
        seeding: As for ``make_mapper``.
        device: Device of the maps.
        given: A loss, an optimiser.

    Raises:
        ValueError: a file is damaged, or the settings do not belong to the map.
    """
    check_together(parent, config)
    mapper = make_mapper(config, seeding=seeding, device=device, **given)
    folder = parent.folder
    state = read_map_state(folder / STATE)
    try:
        fresh = mapper.state_dict()
        whole = fresh | {
            "n_frames": state["n_frames"],
            "steps_taken": state["steps_taken"],
            "n_not_finite": state["n_not_finite"],
            "random": state["random"],
            "keyframes": _counted_back(state["keyframes"], _shift(state)),
            "gaussians": _whole_rows(fresh["gaussians"], state["gaussians"], folder, config),
        }
        if "volume" in fresh:
            whole["volume"] = mapper.files.stored_volume(folder)
        mapper._load(whole)
        _take_rule(mapper, state["rule"])
        places = read_places(folder / PLACES).counted_back(_shift(state))
        mapper.localiser.go_on_in(
            list(state["poses"]),
            [index - _shift(state) for index in state["frame_indices"].tolist()],
            places,
            camera or places.camera,
        )
        _check(mapper, state)
    except SequenceError as e:
        if str(folder) in str(e):
            raise
        raise SequenceError(f"{folder}: {e}") from None
    except Exception as e:  # files that do not belong together
        raise ArgumentError(
            f"the files of {folder} do not fit together, or are damaged: {reason_of(e)}"
        ) from None
    mapper.notes.append(
        f"the map began with that of {folder.name}: {state['n_frames']} frames, "
        f"{len(mapper.gaussians):,} Gaussians"
    )
    return mapper


def _shift(state: dict[str, Any]) -> int:
    """What is taken from each number of a frame of the run, so that all are below 0."""
    indices = state["frame_indices"]
    return (int(indices.max()) + 1 if len(indices) else 0) + GAP


def _counted_back(keyframes: list[dict[str, Any]], shift: int) -> list[dict[str, Any]]:
    return [k | {"index": k["index"] - shift} for k in keyframes]


def _whole_rows(
    fresh: dict[str, Any], stored: dict[str, Any], folder: Path, config: SystemConfig
) -> dict[str, Any]:
    """All columns of the Gaussians: parameters from gaussians.ply, moments of zero."""
    params = read_gaussians(folder, config.sh_degree, "cpu")
    n = len(params)
    rows: dict[str, Tensor] = {name: getattr(params, name) for name in PARAMETERS}
    rows |= stored["rows"]
    lengths = {name: len(column) for name, column in rows.items()}
    if set(lengths.values()) - {n}:
        raise SequenceError(
            f"{folder / STATE} is of {max(set(lengths.values()) - {n})} Gaussians, gaussians.ply "
            f"of {n}"
        )
    for name, column in fresh["rows"].items():
        if name in rows and rows[name].dtype != column.dtype:
            raise SequenceError(f"{name} of the Gaussians is of {rows[name].dtype}")
    zeros = {
        name: torch.zeros(n, *column.shape[1:], dtype=column.dtype)
        for name, column in fresh["rows"].items()
        if name not in rows
    }
    rows["birth_frame"] = torch.full_like(rows["birth_frame"], -1)
    rows["last_step"] = torch.full_like(rows["last_step"], stored["step_count"])
    return {
        "sh_degree": stored["sh_degree"],
        "step_count": stored["step_count"],
        "rows": rows | zeros,
    }


def _take_rule(mapper: Mapper, state: dict[str, Any]) -> None:
    """Give the rule its memory, if it is the rule of the run."""
    if not isinstance(state["name"], str):
        raise SequenceError("the state of a map does not name its seeding rule")
    if state["name"] == rule_name(mapper.rule):
        mapper.rule_in_use.load_state_dict(state)
        if changes := mapper.rule_in_use.difference(state):
            mapper.notes.append(
                f"the seeding rule is not as it was in the run before; different: {changes}"
            )
        else:
            check_same(state, mapper.rule_in_use.state_dict(), ("rule",))
    else:
        mapper.notes.append(
            f"the run goes on with the seeding rule {rule_name(mapper.rule)}; its memory is empty"
        )


def _check(mapper: Mapper, state: dict[str, Any]) -> None:
    """Check that the mapper holds what the file says, nothing converted or passed over."""
    mine = map_state(mapper)
    for name in ("n_frames", "steps_taken", "n_not_finite", "random", "poses"):
        check_same(state[name], mine[name], (name,))
    check_same(_counted_back(state["keyframes"], _shift(state)), mine["keyframes"], ("keyframes",))
    if mapper.n_frames != len(mapper.trajectory.poses):
        raise SequenceError(
            f"the state of a map has {mapper.n_frames} frames and {len(mapper.trajectory.poses)} "
            "poses"
        )
    if strange := set(state["gaussians"]) - set(mine["gaussians"]):
        raise SequenceError(f"of the Gaussians a state has unknown parts: {sorted(strange)}")
    frame_indices = state["frame_indices"].tolist()
    numbers = [keyframe["index"] for keyframe in state["keyframes"]]
    if strange := set(numbers) - set(frame_indices):
        raise SequenceError(f"keyframe {min(strange)} of a state is not among its mapped frames")
    # else of two recordings, one by one
    if len(set(numbers)) < len(numbers) and len(set(frame_indices)) == len(frame_indices):
        raise SequenceError("the state of a map has a keyframe twice")
    if len(frame_indices) != mapper.n_frames:
        raise SequenceError(
            f"the state of a map has {mapper.n_frames} frames and {len(frame_indices)} "
            "numbers of frames"
        )
