"""Kill a run at any moment, go on with it, and compare its maps with those of a run that was never
killed.

    python tests/campaign/kills.py --kills 300

prints the figures of 300 random moments and file operations. Every run is a process of its own (a
fork of this one, before any kernel has run), on the built-in room at 80x60. It is ended by SIGKILL:
at its k-th file operation (before it, after it, or in the middle of a write), after its k-th step,
or at a random time. Then it is resumed, perhaps killed again, until it completes.
"""

import argparse
import contextlib
import io
import json
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

ROOM: dict[str, Any] = {"n_frames": 120, "width": 80, "height": 60}
EVERY_FRAMES = 2
VARIANTS = {
    f"{system}-{poses}": (system, poses)
    for system in ("gsfusion", "rtg_slam", "gps_slam")
    for poses in ("given", "tracked")
}


@dataclass(frozen=True)
class KillPoint:
    """Where a run is killed."""

    kind: str
    """"before", "after" or "within" a file operation, at a "step", or at a "time"."""
    at: float
    """Number of the operation or step, from 1; or seconds."""


@dataclass
class Figures:
    """What a campaign found."""

    kills: Counter = field(default_factory=Counter)
    identical: int = 0
    before_first: int = 0
    """Killed before there was a checkpoint; the run was begun anew."""
    while_writing: int = 0
    """Killed while the maps were written."""
    lost_steps: int = 0
    """The most steps that had to be done again, per kill."""
    failures: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        kinds = ", ".join(f"{n} {kind}" for kind, n in sorted(self.kills.items()))
        lines = [
            f"kills: {sum(self.kills.values())} ({kinds})",
            f"runs killed before their first checkpoint, begun anew: {self.before_first}",
            f"killed while the maps were written: {self.while_writing}",
            f"most steps done again after a kill: {self.lost_steps} (a checkpoint every "
            f"{EVERY_FRAMES})",
            f"resumed maps identical: {self.identical}; different or failed: {len(self.failures)}",
        ]
        return "\n".join([*lines, *self.failures])


def settings(system: str, poses: str) -> Any:
    """Small settings of a system: nine frames and two passes."""
    from gsfusion_nb.config import gps_slam, gsfusion, rtg_slam

    shared = {
        "data__stop": 12,
        "data__hold_out_every": 4,
        "data__hold_out_offset": 2,
        "tracking__poses": poses,
    }
    if system == "gsfusion":
        small = {
            "tsdf__voxel_size_m": 0.04,
            "tsdf__truncation_voxels": 4.0,
            "seeding__quadtree_threshold": 0.01,
        }
        return gsfusion(
            "replica",
            sh_degree=1,
            keyframe_min_seeds=20,
            optim__global_iterations=2,
            **small,
            **shared,
        )
    if system == "gps_slam":
        small = {"tsdf__voxel_size_m": 0.04, "schedule__every_frames": 4}
        return gps_slam("room", data__width=0, data__height=0, final__passes=2, **small, **shared)
    return rtg_slam("room", data__width=0, data__height=0, final__passes=2, **shared)


def child(
    variant: tuple[str, str],
    folder: Path,
    *,
    every: int = EVERY_FRAMES,
    kill: KillPoint | None = None,
) -> int:
    """Start a process that begins the run in ``folder``, or goes on with it; its id."""
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        sys.stderr = io.StringIO()
        _run(variant, folder, every, kill)
        code = 0
    except BaseException:
        with contextlib.suppress(OSError):
            folder.with_suffix(".error").write_text(traceback.format_exc())
    finally:
        os._exit(code)
    return 0


def _run(
    variant: tuple[str, str],
    folder: Path,
    every: int,
    kill: KillPoint | None,
) -> None:
    import torch

    from gsfusion_nb.runs import CheckpointEvery, mapping_run, resume_mapping, run_mapping
    from gsfusion_nb.runs.run_folder import is_complete

    torch.set_num_threads(1)
    operations = Operations(folder, kill)
    operations.watch()
    steps = [0]
    after_step = mapping_run.MappingRun.__setattr__

    def watched(self: Any, name: str, value: Any) -> None:
        if name == "after_step":
            value = _counted(value, steps, folder, kill)
        after_step(self, name, value)

    mapping_run.MappingRun.__setattr__ = watched  # pyright: ignore[reportAttributeAccessIssue]
    checkpoints = CheckpointEvery(seconds=0, frames=every)
    if is_complete(folder):  # killed after its last file
        hashes = json.loads((folder / "metrics.json").read_text())["sha256"]
    elif has_checkpoint(folder):
        hashes = resume_mapping(folder, evaluate=False, checkpoints=checkpoints).run.hashes
    else:  # into the same folder, which refuses whatever is worth keeping
        folder.with_suffix(".steps").unlink(missing_ok=True)
        run = run_mapping(
            "room",
            settings(*variant),
            folder=folder,
            evaluate=False,
            checkpoints=checkpoints,
            **ROOM,
        )
        hashes = run.run.hashes
    result = {"sha256": hashes, "operations": operations.n, "steps": steps[0]}
    folder.with_suffix(".result").write_text(json.dumps(result))


def _counted(
    after_step: Any,
    steps: list[int],
    folder: Path,
    kill: KillPoint | None,
) -> Any:
    """``after_step`` that also counts, tells the parent, and dies when it is time."""

    log = folder.with_suffix(".steps")

    def counted() -> None:
        steps[0] += 1
        with log.open("ab") as file:
            file.write(b".")
        if kill is not None and kill.kind == "step" and steps[0] == kill.at:
            os.kill(os.getpid(), signal.SIGKILL)
        after_step()

    return counted


class Operations:
    """Counts the operations that change files in a folder, and dies at one of them."""

    def __init__(self, folder: Path, kill: KillPoint | None):
        self.folder = f"{folder}{os.sep}"
        self.n = 0
        self.kill = (
            kill if kill is not None and kill.kind in ("before", "after", "within") else None
        )

    def watch(self) -> None:
        """Put counting in place of the functions of ``os`` and ``io``."""
        for name in ("replace", "unlink", "mkdir", "rmdir"):
            setattr(os, name, self._watched(getattr(os, name)))
        os.fsync = self._watched(os.fsync, any_path=True)
        plain = io.open

        def opened(
            path: Any,
            mode: str = "r",
            *rest: Any,
            **options: Any,
        ) -> Any:
            file = plain(path, mode, *rest, **options)
            return _Writing(file, self) if set(mode) & set("wax+") and self._is_ours(path) else file

        io.open = opened

    def count(self, do: Any, within: Any = None) -> Any:
        """Do one operation; die before it, after it, or after a part of it."""
        self.n += 1
        kill = self.kill
        if kill is None or self.n != kill.at:
            return do()
        if kill.kind == "after":
            do()
        if kill.kind == "within" and within is not None:
            within()
        os.kill(os.getpid(), signal.SIGKILL)
        return None

    def _is_ours(self, path: Any) -> bool:
        return f"{path}{os.sep}".startswith(self.folder)

    def _watched(self, function: Any, any_path: bool = False) -> Any:
        def watched(path: Any, *rest: Any, **options: Any) -> Any:
            if not any_path and not self._is_ours(path):
                return function(path, *rest, **options)
            return self.count(lambda: function(path, *rest, **options))

        return watched


class _Writing:
    """A file whose writes are counted."""

    def __init__(self, file: Any, operations: Operations):
        self._file = file
        self._operations = operations

    def write(self, content: Any) -> Any:
        def half() -> None:
            self._file.write(content[: len(content) // 2])
            self._file.flush()

        return self._operations.count(lambda: self._file.write(content), half)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __enter__(self) -> "_Writing":
        return self

    def __exit__(self, *error: Any) -> None:
        self._file.close()


def has_checkpoint(folder: Path) -> bool:
    """Whether a checkpoint was completed in the folder of a run; looking changes nothing there."""
    return any(re.fullmatch(r"\d{6}\.json", path.name) for path in folder.glob("checkpoint/*"))


def _says_complete(folder: Path) -> bool:
    path = folder / "metrics.json"
    return path.exists() and json.loads(path.read_text())["status"] == "complete"


def finish(pid: int, seconds: float | None = None) -> bool:
    """Wait for a process, or kill it after ``seconds``; whether it was killed."""
    if seconds is not None:
        time.sleep(seconds)
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    return os.WIFSIGNALED(status)


def whole(
    variant: tuple[str, str],
    folder: Path,
    every: int = EVERY_FRAMES,
) -> dict[str, Any]:
    """The result of a run that is not killed."""
    began = time.monotonic()
    finish(child(variant, folder, every=every))
    if not folder.with_suffix(".result").exists():
        raise RuntimeError(folder.with_suffix(".error").read_text())
    return json.loads(folder.with_suffix(".result").read_text()) | {
        "seconds": time.monotonic() - began
    }


def kill_and_resume(
    variant: tuple[str, str],
    folder: Path,
    kills: list[KillPoint],
    unkilled: dict[str, Any],
    figures: Figures,
) -> None:
    """Kill a run at each of ``kills`` in turn, let it complete, and compare it with
    ``unkilled``."""
    expected = unkilled["sha256"]
    n_steps = unkilled["steps"]
    n_killed = 0
    for kill in kills:
        seconds = kill.at if kill.kind == "time" else None
        if not finish(child(variant, folder, kill=kill), seconds):
            break
        n_killed += 1
        figures.kills[kill.kind] += 1
        figures.before_first += (
            not has_checkpoint(folder) and not (folder / "metrics.json").exists()
        )
        written = (folder / "config.json").exists() and n_killed == 1
        figures.while_writing += written and not _says_complete(folder)
    try:
        result = whole(variant, folder)
    except RuntimeError as e:
        figures.failures.append(f"{variant} {kills}: {e}")
        return
    left = [path.name for path in folder.rglob("*.partial*")]
    if left or not _says_complete(folder):
        figures.failures.append(
            f"{variant} {kills}: left {left}, complete: {_says_complete(folder)}"
        )
    elif result["sha256"] == expected:
        figures.identical += 1
        again = folder.with_suffix(".steps").stat().st_size - n_steps
        figures.lost_steps = max(figures.lost_steps, -(-again // max(1, n_killed)))
    else:
        figures.failures.append(f"{variant} {kills}: {result['sha256']} instead of {expected}")
    shutil.rmtree(folder, ignore_errors=True)
    for suffix in (".result", ".steps"):
        folder.with_suffix(suffix).unlink(missing_ok=True)


def campaign(
    n_kills: int,
    seed: int,
    variants: list[tuple[str, str]],
    folder: Path,
) -> Figures:
    """Runs of all ``variants``, killed ``n_kills`` times in all."""
    import gsfusion_nb.runs  # noqa: F401  (imported before the forks)

    draw = random.Random(seed)
    figures = Figures()
    results = {v: whole(v, folder / "-".join(v)) for v in variants}
    for variant in variants:
        plain = whole(variant, folder / f"plain-{'-'.join(variant)}", every=0)
        if plain["sha256"] != results[variant]["sha256"]:
            figures.failures.append(f"{variant}: checkpoints change the maps")
    n = 0
    operation = Counter()
    while sum(figures.kills.values()) < n_kills:
        variant = variants[n % len(variants)]
        whole_run = results[variant]
        kills = []
        for _ in range(draw.choice((1, 1, 2))):
            kind = draw.choice(("before", "after", "within", "step", "time"))
            # few kills are spread over the run
            apart = max(1, whole_run["operations"] * len(variants) // n_kills)
            operation[variant] = (operation[variant] + apart - 1) % whole_run["operations"] + 1
            at = {
                "step": draw.randint(1, whole_run["steps"]),
                "time": draw.uniform(0.2, 1.0) * whole_run["seconds"],
            }
            kills.append(KillPoint(kind, at.get(kind, operation[variant])))
        kill_and_resume(variant, folder / f"run-{n}", kills, whole_run, figures)
        n += 1
        sys.stderr.write(
            f"{sum(figures.kills.values())} of {n_kills} kills, {len(figures.failures)} failures\n"
        )
    return figures


def main() -> int:
    """Run a campaign and print its figures; 1 if a map differed or a run failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS), help="all by default"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        figures = campaign(
            options.kills,
            options.seed,
            [VARIANTS[v] for v in options.variants],
            Path(folder),
        )
    sys.stdout.write(f"{figures}\n")
    return 1 if figures.failures else 0


if __name__ == "__main__":
    sys.exit(main())
