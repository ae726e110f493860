"""Which tests execute a line, and what they say about a mutant: processes forked from one that has
loaded PyTorch."""

import contextlib
import importlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from mutant_sites import Mutant, mutated

HEAVY = (
    "torch numpy numba cv2 scipy.spatial scipy.optimize scipy.sparse scipy.ndimage "
    "matplotlib.pyplot PIL.Image kornia"
)
"""What is loaded once, before any process is forked. The package itself is not: each process loads
its own mutant."""
MEMORY_BYTES = 12 * 1024**3
"""Address space of a process: a mutant may ask for any amount."""
OPTIONS = ("-q", "-n0", "-x", "-p", "no:cacheprovider", "--no-header", "--tb=no", "--capture=fd")


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """What each test executes."""

    seconds: dict[str, float]
    """Test -> its time on a processor. Only tests that pass."""
    lines: dict[str, dict[int, list[str]]]
    """File -> line -> tests."""

    def of(self, mutant: Mutant, most_s: float) -> list[str]:
        """Tests for a mutant, those of one file together: first those that execute its line, then
        the others that execute anything of its module, because a test may find what another one has
        made or put into a cache.

        Args:
            mutant: The change.
            most_s: No further tests are chosen when these take so long, seconds.
        """
        lines = self.lines.get(mutant.file, {})
        room = "/".join(mutant.file.split("/")[:2])
        of_module = {test for tests in lines.values() for test in tests}
        if mutant.runs_with:
            # or an import does
            direct = {test for i in mutant.runs_with for test in lines.get(i, ())} or of_module
        else:  # a module of constants
            modules = [
                by_line for file, by_line in self.lines.items() if file.startswith(f"{room}/")
            ]
            direct = {test for by_line in modules for tests in by_line.values() for test in tests}
        files = {_file(test) for test in direct}
        near = {test for test in of_module - direct if _file(test) in files}
        far = of_module - direct - near if direct else set()
        chosen = []
        spent = 0.0
        for test in [
            test for group in (direct, near, far) for test in self._in_order(group, mutant)
        ]:
            if spent + self.seconds[test] <= most_s or not chosen:
                chosen.append(test)
                spent += self.seconds[test]
        return chosen

    def _in_order(self, tests: Iterable[str], mutant: Mutant) -> list[str]:
        """By file, the room's own first and then the quickest; in a file the quickest first."""
        files = defaultdict(list)
        for test in tests:
            files[_file(test)].append(test)
        room = mutant.file.split("/")[1]

        def cost(file: str) -> tuple[bool, float, str]:
            return (
                not file.startswith(f"tests/{room}/"),
                sum(self.seconds[t] for t in files[file]),
                file,
            )

        return [
            t
            for file in sorted(files, key=cost)
            for t in sorted(files[file], key=lambda t: (self.seconds[t], t))
        ]


def _file(test: str) -> str:
    return test.partition("::")[0]


def copy_of(root: Path, folder: Path) -> Path:
    """A copy of what git knows of a checkout, and of its compiled kernels, with the times of their
    files.

    A mutant whose tests had to compile the kernels first would run out of its time, and count as
    killed.
    """
    names = subprocess.check_output(["git", "-C", str(root), "ls-files", "-z"], text=True).split(
        "\0"
    )
    compiled = [path.relative_to(root).as_posix() for path in (root / "kernels").rglob("*.nb[ic]")]
    for name in filter(None, [*names, *compiled]):
        if (root / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / name, folder / name)
    return folder


def load_once() -> None:
    """Load what every process needs and no mutant changes."""
    for name in HEAVY.split():
        importlib.import_module(name)


def warm(tree: Path, folders: Sequence[str], scratch: Path) -> None:
    """Compile what the tests in ``folders`` import, so that each mutant's process compiles its own
    module only."""
    _forked(tree, scratch, 0, lambda: _pytest(folders, options=[*OPTIONS, "--collect-only"]))


def covered(
    tree: Path,
    folders: Sequence[str],
    scratch: Path,
    file: Path,
) -> None:
    """Run the tests in ``folders`` and write what each executes to ``file``."""
    code = _forked(tree, scratch, 0, lambda: _measure(tree, folders, scratch, file))
    if code or not file.exists():
        raise RuntimeError(
            f"the tests in {', '.join(folders)} cannot be measured; see {scratch / 'out.txt'}"
        )
    failed = json.loads(file.read_text())["failed"]
    if failed:
        sys.stderr.write(
            f"{len(failed)} tests fail without any change, so they guard nothing here: "
            f"{', '.join(failed)}\n"
        )


def read_coverage(files: Iterable[Path]) -> Coverage:
    """What ``covered`` has written to several files."""
    seconds: dict[str, float] = {}
    lines: dict[str, dict[int, list[str]]] = defaultdict(lambda: defaultdict(list))
    for file in files:
        part = json.loads(file.read_text())
        seconds |= part["seconds"]
        for name, by_line in part["lines"].items():
            for line, rows in by_line.items():
                lines[name][int(line)] += [part["tests"][i] for i in rows]
    return Coverage(seconds=seconds, lines=lines)


def verdict(
    tree: Path,
    mutant: Mutant,
    tests: Sequence[str],
    seconds: float,
    scratch: Path,
) -> str:
    """ "killed", "survived" or "timed out": what the tests say about a mutant in a copy of the
    checkout.

    Args:
        tree: The copy; the mutant's file is as before at the end.
        mutant: The change.
        tests: Names of tests, in their order.
        seconds: Time that the tests take without the change; five times as much of a processor's
            time, and 20 s, is the limit.
        scratch: Folder for the output and for what tests write.
    """
    if not tests:
        return "survived"
    path = tree / mutant.file
    source = path.read_text("utf-8")
    stat = path.stat()
    try:
        path.write_text(mutated(source, mutant.operator, mutant.occurrence), "utf-8")
        limit = round(20 + 5 * seconds)
        code = _forked(
            tree,
            scratch,
            limit,
            lambda: _pytest(list(dict.fromkeys(map(_file, tests))), Only(tests)),
        )
    finally:
        path.write_text(source, "utf-8")
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    if code in (0, 5):
        return "survived"
    return "timed out" if code == -signal.SIGXCPU or code == -signal.SIGKILL else "killed"


def _pytest(
    files: Sequence[str],
    *plugins: Any,
    options: Sequence[str] = OPTIONS,
) -> int:
    return int(
        pytest.main(
            [*options, f"--basetemp={os.environ['MUTANT_SCRATCH']}/tests", *files], plugins=plugins
        )
    )


def _forked(tree: Path, scratch: Path, limit_s: int, work: Any) -> int:
    """Exit status of a process that does ``work`` in the copy; below 0 the signal that ended it."""
    scratch.mkdir(parents=True, exist_ok=True)
    pid = os.fork()
    if pid == 0:
        code = 70
        with contextlib.suppress(BaseException):
            _settle(tree, scratch, limit_s)
            code = work()
        os._exit(code)
    deadline = time.monotonic() + 15 * limit_s if limit_s else float("inf")
    while True:
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            break
        if time.monotonic() > deadline:
            os.killpg(pid, signal.SIGKILL)
        time.sleep(0.02)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)  # what the tests have started
    shutil.rmtree(scratch / "tests", ignore_errors=True)
    return os.waitstatus_to_exitcode(status)


def _settle(tree: Path, scratch: Path, limit_s: int) -> None:
    os.setsid()
    out = os.open(scratch / "out.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(out, stream)
    if limit_s:
        resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s + 5))
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    os.chdir(tree)
    os.environ |= {"PYTHONPATH": str(tree), "MUTANT_SCRATCH": str(scratch)}
    sys.path[:] = [str(tree), *(path for path in sys.path if not path.endswith("campaign"))]
    sys.dont_write_bytecode = bool(limit_s)  # of a mutant


class Only:
    """Plugin of pytest: only these tests, in this order."""

    def __init__(self, tests: Sequence[str]):
        self.place = {test: i for i, test in enumerate(tests)}

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = sorted(
            (i for i in items if i.nodeid in self.place), key=lambda item: self.place[item.nodeid]
        )


class Recorder:
    """Plugin of pytest: tells coverage which test runs, or which fixture that several tests share
    is made."""

    def __init__(self, coverage: Any):
        self.coverage = coverage
        self.context = ""
        self.seconds: dict[str, float] = {}
        self.failed: set[str] = set()
        self.shared: dict[str, list[str]] = {}
        """Test -> contexts of the shared fixtures that it uses."""

    def _switch(self, context: str) -> str:
        before = self.context
        self.context = context
        os.environ["MUTANT_CONTEXT"] = context
        self.coverage.switch_context(context)
        return before

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Any:
        self._switch(item.nodeid)
        fixtures = item._fixtureinfo.name2fixturedefs.values()
        self.shared[item.nodeid] = [
            _shared(f[-1]) for f in fixtures if f and f[-1].scope != "function"
        ]
        before = sum(os.times()[:4])  # its own and its processes'
        yield
        self.seconds[item.nodeid] = sum(os.times()[:4]) - before
        self._switch("")

    @pytest.hookimpl(hookwrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Any:
        before = self._switch(_shared(fixturedef)) if fixturedef.scope != "function" else None
        yield
        if before is not None:
            self._switch(before)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if not report.passed:
            self.failed.add(report.nodeid)


def _shared(fixture: Any) -> str:
    return f"fixture {fixture.baseid} {fixture.argname}"


CONFIG = """[run]
data_file = ${MUTANT_SCRATCH}/coverage
parallel = true
source = ${MUTANT_TREE}/gsfusion_nb
context = ${MUTANT_CONTEXT}
"""
"""Of the processes that tests start: what they execute counts for the test that runs."""
STARTS = "import coverage\n\ncoverage.process_startup()\n"
"""What each Python process of a test does first."""


def _measure(
    tree: Path,
    folders: Sequence[str],
    scratch: Path,
    file: Path,
) -> int:
    import coverage

    (scratch / "config").write_text(CONFIG)
    (scratch / "sitecustomize.py").write_text(STARTS)
    os.environ |= {
        "COVERAGE_PROCESS_START": str(scratch / "config"),
        "MUTANT_CONTEXT": "",
        "MUTANT_TREE": str(tree),
    }
    os.environ["PYTHONPATH"] = f"{scratch}{os.pathsep}{tree}"
    cov = coverage.Coverage(
        data_file=str(scratch / "coverage"), source=[str(tree / "gsfusion_nb")], messages=False
    )
    recorder = Recorder(cov)
    cov.erase()
    cov.start()
    code = _pytest(folders, recorder, options=[option for option in OPTIONS if option != "-x"])
    cov.stop()
    cov.combine(keep=False)
    data = cov.get_data()
    kept = [test for test in recorder.seconds if test not in recorder.failed]
    number = {test: i for i, test in enumerate(kept)}
    users = defaultdict(list)
    for test in kept:
        for context in (test, *recorder.shared.get(test, ())):
            users[context].append(number[test])
    lines = {}
    for name in data.measured_files():
        by_line = {
            line: sorted({i for context in contexts for i in users.get(context, ())})
            for line, contexts in data.contexts_by_lineno(name).items()
        }
        lines[Path(name).relative_to(tree).as_posix()] = {
            line: tests for line, tests in by_line.items() if tests
        }
    seconds = {test: recorder.seconds[test] for test in kept}
    failed = sorted(recorder.failed)
    measured = {"tests": kept, "failed": failed, "seconds": seconds, "lines": lines}
    file.write_text(json.dumps(measured))
    return 0 if code in (0, 1) else code
