"""Whether another version of the program makes the same maps: small maps of every system, fidelity,
seeding rule and switch, and small rows of the lab, as hashes of their bits and scores.

    python tools/same_maps.py                    # prints the hashes of this version, as JSON
    python tools/same_maps.py --since COMMIT     # compares them with those of a commit

Bits are those of one machine: another processor may round in another way, so both versions run
here. ``tools/measured.py --confirm`` uses it for tables whose files have changed.
"""

import argparse
import dataclasses
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import UnionType
from typing import Any, Literal

ROOT = Path(__file__).resolve().parents[1]
ROOMS = (
    "gsfusion_nb/compare/map_scene.py",
    "gsfusion_nb/compare/one_run.py",
    "gsfusion_nb/compare/schedule.py",
    "gsfusion_nb/compare/tune.py",
    "gsfusion_nb/config/",
    "gsfusion_nb/data/room/",
    "gsfusion_nb/evaluation/",
    "gsfusion_nb/gaussians/",
    "gsfusion_nb/geometry/",
    "gsfusion_nb/large_maps/",
    "gsfusion_nb/mapping/",
    "gsfusion_nb/optim/",
    "gsfusion_nb/render/",
    "gsfusion_nb/seeding/",
    "gsfusion_nb/tracking/",
    "gsfusion_nb/tsdf/",
    "kernels/",
)
"""What these maps and rows are made by. Of a change elsewhere they say nothing."""
WALK: dict[str, Any] = {"n_frames": 90, "width": 160, "height": 120, "noise": "kinect"}
SMALL: dict[str, Any] = {
    "data__width": 64,
    "data__height": 48,
    "data__stop": 9,
    "data__hold_out_every": 4,
    "data__hold_out_offset": 2,
}
COARSE = {"tsdf__voxel_size_m": 0.05}
OFTEN: dict[str, dict[str, Any]] = {
    "gsfusion": {"optim__global_iterations": 2, **COARSE},
    "rtg_slam": {
        "window__every_frames": 2,
        "keyframes__iterations": 4,
        "states__stable_confidence": 20.0,
        "states__unstable_frames": 3,
        "states__error_count": 1,
        "final__passes": 2,
    },
    "gps_slam": {
        "schedule__every_frames": 2,
        "schedule__window_every": 2,
        "final__passes": 2,
        **COARSE,
    },
}
"""Settings with which all parts of a system take part in a walk of nine frames."""
LAB_GAUSSIANS = 300
"""Budget of the rows of the lab, which is reached by tuning."""
LAB_ROWS: dict[str, dict[str, Any]] = {
    "gsfusion": {},
    "uniform": {},
    "edge_strokes": {},
    "rtg_slam": {"system": "rtg_slam"},
    "gps_slam": {"system": "gps_slam"},
    "mcmc": {"options": {"seeds_by": "uniform", "refine_start_iter": 10, "refine_every": 5}},
}
"""Rule -> what its row of the lab has besides."""
NOT_OF_THE_MAP = ("seconds_", "fps_", "peak_", "processor_")
"""Metrics that begin so are times and memory."""
Changes = dict[str, Any]


def cases() -> Iterator[tuple[str, str, str, Changes]]:
    """Name, system, fidelity and changed settings of each map."""
    from gsfusion_nb.mapping.systems import SYSTEMS
    from gsfusion_nb.seeding.rule import registered

    for system, mapper in SYSTEMS.items():
        for fidelity in mapper.description.fidelities:
            yield f"{system} {fidelity}", system, fidelity, {}
        for path, value in switches(mapper.preset("room")):
            if path.startswith("data__repair"):  # of the recording, before it is mapped
                continue
            yield f"{system} {path}={value}", system, "measured", {path: value}
        for name, changes in together(system).items():
            yield f"{system} {name}", system, "measured", changes
    for rule in registered():
        yield f"rule {rule}", "gsfusion", "measured", {"seeding__rule": rule}


def switches(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Each setting that is a switch or one of a few words, with each of its other values."""
    hints = typing.get_type_hints(type(config))
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        path = f"{prefix}{field.name}"
        if dataclasses.is_dataclass(value):
            yield from switches(value, f"{path}__")
            continue
        for other in words_of(hints[field.name]):
            if other != value:
                yield path, other


def words_of(hint: Any) -> tuple[Any, ...]:
    """The values of a switch or of a choice of words; none of another type."""
    if typing.get_origin(hint) is typing.Annotated:
        return words_of(typing.get_args(hint)[0])
    if typing.get_origin(hint) in (typing.Union, UnionType):
        return ()
    if hint is bool:
        return (False, True)
    return typing.get_args(hint) if typing.get_origin(hint) is Literal else ()


def together(system: str) -> dict[str, Changes]:
    """Further settings that need each other."""
    cases: dict[str, Changes] = {
        "tracked with landmarks": {"tracking__poses": "tracked", "tracking__landmarks": True},
        "tracked with a back end": {"tracking__poses": "tracked", "tracking__back_end": True},
        "without view-dependent colour": {"sh_degree": 0},
        "of more than 10,000 Gaussians": {
            "seeding__rule": "splatam" if system == "rtg_slam" else "dense",
            "seeding__options": {},
            "data__width": 160,
            "data__height": 120,
        },
    }
    if system == "gsfusion":
        cases["poses and light"] = {
            "optim__refine_poses": True,
            "optim__fit_exposure": True,
            "data__align_held_out": True,
        }
    return cases


def hash_of_map(system: str, fidelity: str, changes: Changes) -> str:
    """Hash of the files of a small map; without changes also of its scores. Of a refusal, its
    text."""
    from gsfusion_nb.mapping.systems import get_system
    from gsfusion_nb.runs import run_mapping

    try:
        config = get_system(system).preset("room", fidelity, **(SMALL | OFTEN[system] | changes))
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder) / "run"
            run_mapping("room", config, folder=place, evaluate=is_scored(changes), **WALK)
            document = json.loads((place / "metrics.json").read_text(encoding="utf-8"))
    except (ValueError, TypeError, KeyError) as error:
        return f"{type(error).__name__}: {error}"
    scores = {k: v for k, v in document["metrics"].items() if not k.startswith(NOT_OF_THE_MAP)}
    text = json.dumps([document["sha256"], scores], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def is_scored(changes: Changes) -> bool:
    """Whether a map is scored, which takes longer than to make it."""
    return not changes or "data__align_held_out" in changes


def hash_of_row(rule: str) -> str:
    """Hash of map and numbers of a small row of the lab; of one that failed, why."""
    from gsfusion_nb.compare import Budget, RunSpec, run_spec
    from gsfusion_nb.compare.run_result import MEASURED

    given = LAB_ROWS[rule]
    small = SMALL | OFTEN[given.get("system", "gsfusion")]
    spec = RunSpec(
        rule=rule,
        data="room",
        reader=WALK,
        budget=Budget(gaussians=LAB_GAUSSIANS),
        settings={path.replace("__", "."): value for path, value in small.items()},
        **given,
    )
    result = run_spec(spec)
    if result.status == "failed":
        return result.reason
    numbers = {k: v for k, v in result.metrics.items() if k not in MEASURED}
    text = json.dumps([result.map_hash, numbers, dict(result.tuned)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def hashes() -> dict[str, str]:
    """Name of each map or row -> its hash, by the version that is imported."""
    maps = {name: hash_of_map(*case) for name, *case in cases()}  # pyright: ignore[reportArgumentType]
    return maps | {f"row of {rule}": hash_of_row(rule) for rule in LAB_ROWS}


def hashes_of_folder(folder: Path) -> dict[str, str]:
    """The same by the version in a folder, in a process of its own.

    Raises:
        RuntimeError: the process failed.
    """
    environment = os.environ | {"PYTHONPATH": str(folder)}
    call = [sys.executable, str(Path(__file__).resolve()), "--expect", str(folder)]
    process = subprocess.run(call, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True)
    if process.returncode != 0:
        raise RuntimeError(f"the maps of the version in {folder} could not be made")
    return json.loads(process.stdout.strip().splitlines()[-1])


def hashes_of_commit(commit: str, root: Path = ROOT) -> dict[str, str]:
    """The same by the version of a commit, in a worktree that is removed afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "then"
        git = ["git", "-C", str(root), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", str(place), commit], check=True)
        try:
            # where the installed package has them; without, the reference would make the maps
            (place / "gsfusion_nb/kernels").symlink_to(place / "kernels")
            return hashes_of_folder(place)
        finally:
            subprocess.run([*git, "remove", "--force", str(place)], check=True)


def check_imported(folder: Path) -> None:
    """Check that package and kernels are those in ``folder``.

    Raises:
        RuntimeError: they are others.
    """
    import gsfusion_nb
    import gsfusion_nb.kernels

    for module in (gsfusion_nb, gsfusion_nb.kernels):
        place = Path(module.__path__[0]).resolve().parent
        if place != folder:
            raise RuntimeError(
                f"expected {module.__name__} of the version in {folder}, imported that in {place}"
            )


def differences(then: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Names of the maps of ``then`` that are others now, or cannot be made."""
    return [name for name, value in then.items() if now.get(name) != value]


def main(arguments: list[str] | None = None) -> int:
    """Print hashes, or compare with a commit. Returns the exit status: 1 where a map differs."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--since", metavar="COMMIT", help="compare with the version of this commit")
    parser.add_argument("--expect", metavar="FOLDER", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.since:
        others = differences(hashes_of_commit(options.since), hashes_of_folder(ROOT))
        print("\n".join(others) or "all maps are the same")
        return 1 if others else 0
    if options.expect:
        check_imported(Path(options.expect).resolve())
    print(json.dumps(hashes()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
