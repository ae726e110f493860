"""The check of an entrant in a process of its own:
``python -m gsfusion_nb.compare.fresh_check JOB``.

Nothing that the caller has loaded or changed is there. Where the system can (Landlock, Linux 5.13),
compiled code can read only the files that the rule declares, too.
"""

import ctypes
import json
import os
import pickle
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..code_keys import CodeKey, code_key
from ..code_keys.installed import is_installed
from ..code_keys.origin import is_library_namespace
from ..code_keys.patches import changes_since, library_state, switches
from ..errors import ArgumentError
from ..files import cache_folder
from ..seeding import check_rule
from ..seeding.code_files import refuse_undeclared
from ..seeding.rule import option_paths
from ..seeding.rule_code import rule_of_source
from ..seeding.rule_guard import only_declared
from ..seeding.rule_watch import SYSTEM_FOLDERS


@dataclass(frozen=True, kw_only=True)
class CheckJob:
    """What is checked."""

    name: str
    source: str = ""
    """Of the rule's file; empty if ``pickled`` has the rule."""
    file: str = ""
    folder: str = ""
    pickled: bytes = b""
    options: Mapping[str, Any]
    extra: bytes = b""
    """The pickled function that gives further images of each frame; empty: there are none."""


_ALONE = "in a process of its own, which can read only the files that the options name: "


def main(job_file: str) -> int:
    """Do the job in a file, and write what was found to the file beside it (.json): "refused", why,
    or empty; "code", the parts of the rule's key; "walks_sets", whether its code has sets; and
    "seeds", a hash of what it gave."""
    report: dict[str, Any] = {"refused": "", "code": {}, "walks_sets": False, "seeds": ""}
    path = Path(job_file)
    try:
        job: CheckJob = pickle.loads(path.read_bytes())
        key, report["seeds"] = _check(job)
        report |= {"code": dict(key.parts), "walks_sets": key.walks_sets}
    except Exception as e:  # a rule may raise anything
        is_sentence = isinstance(e, (AssertionError, ValueError)) and str(e)
        report["refused"] = str(e) if is_sentence else f"{_ALONE}{type(e).__name__}: {e}"
    path.with_suffix(".json").write_text(json.dumps(report), encoding="utf-8")
    return 0


def _check(job: CheckJob) -> tuple[CodeKey, str]:
    """Check a rule. Returns its key, and a hash of what it gave.

    Raises:
        Exception: what the rule or ``check_rule`` raises; ValueError for what only a fresh process
            shows.
    """
    check_rule("uniform")  # so that what libraries load when they are first used is there
    libraries = library_state()
    switches_at_start = switches()
    rule = _load(job)
    extra = pickle.loads(job.extra) if job.extra else None
    key = code_key(rule)
    refuse_undeclared(rule, key.files)
    paths = [*option_paths(rule, job.options).values(), *key.files]
    confine([*SYSTEM_FOLDERS, *filter(is_installed, sys.path), cache_folder(), *paths])
    with _clock_is_watched(job.name), only_declared(job.name, paths):
        digest = check_rule(rule, options=job.options, extra=extra).digest
    if changes := changes_since(libraries, all_of_package=True):
        raise ArgumentError(
            f"the seeding rule {job.name!r} changes {', '.join(changes[:3])} for everybody; a rule "
            "may not change what it imports: write a function of its own"
        )
    switches_at_end = switches()
    if switch_names := [
        name for name in switches_at_start if switches_at_start[name] != switches_at_end[name]
    ]:
        raise ArgumentError(
            f"the seeding rule {job.name!r} changes a setting of the whole process: "
            f"{', '.join(switch_names)}"
        )
    return key, digest


def _load(job: CheckJob) -> Any:
    if job.pickled:
        return pickle.loads(job.pickled)
    return rule_of_source(
        job.source,
        job.name,
        job.file,
        Path(job.folder) if job.folder else None,
    )


_SYSTEM = ("posix", "nt")
_OF_PROCESS = {
    *(
        (m, name)
        for m in _SYSTEM
        for name in ("getpid", "getppid", "getcwd", "getcwdb", "getlogin", "uname", "times")
    ),
    *((m, name) for m in _SYSTEM for name in ("urandom", "getloadavg", "statvfs")),
    *((m, name) for m in _SYSTEM for name in ("cpu_count", "sched_getaffinity")),
    ("torch._C", "get_num_threads"),
    *(
        ("_socket", "gethostname"),
        ("socket", "gethostname"),
        ("_thread", "get_ident"),
        ("_thread", "get_native_id"),
    ),
    *(("builtins", "id"), ("resource", "getrusage")),
}
"""Module and name of functions whose answer another process, or another machine, does not get."""
_TOLD_BY_PYTHON = {
    ("platform", "node"),
    ("platform", "uname"),
    ("uuid", "getnode"),
    ("uuid", "uuid1"),
    ("email.utils", "formatdate"),
    ("email.utils", "localtime"),
    ("pathlib", "cwd"),
    ("pathlib._local", "cwd"),
    ("shutil", "disk_usage"),
}
"""The same for functions that Python itself has in its own language."""
_OF_A_GIVEN_TIME = {"sleep": -1, "strftime": 1, "gmtime": 0}
"""Functions of ``time`` that can be told a time -> the number of their arguments without one; -1:
they say nothing of the time."""


class _clock_is_watched:
    """Context that raises ``ValueError`` at its end if somebody's own code in it has asked for the
    time, or for what else differs from process to process."""

    def __init__(self, rule: str):
        self._rule = rule
        self._asked = ""
        self._what = "the time"

    def __enter__(self) -> None:
        sys.setprofile(self._note)

    def __exit__(self, kind: Any, error: Any, traceback: Any) -> None:
        sys.setprofile(None)
        if self._asked and (error is None or isinstance(error, Exception)):
            raise ArgumentError(
                f"the seeding rule {self._rule!r} asks for {self._what} ({self._asked}); its seeds "
                "may depend on the context only"
            )

    def _note(self, frame: Any, event: str, function: Any) -> None:
        if self._asked:
            return
        if event == "call":
            asked = frame.f_globals.get("__name__"), frame.f_code.co_name
            if asked in _TOLD_BY_PYTHON and frame.f_back is not None:
                self._note_asked(frame.f_back, *asked, is_clock=False)
        elif event == "c_call":
            owner = getattr(function, "__self__", None)
            name = getattr(function, "__name__", "")
            module = getattr(owner, "__name__", "") or getattr(owner, "__module__", "")
            is_clock = (module == "time" and _is_without_a_time(name, frame)) or (
                module in ("datetime", "date") and name in ("now", "utcnow", "today")
            )
            if is_clock or (module, name) in _OF_PROCESS:
                self._note_asked(frame, module, name, is_clock=is_clock)

    def _note_asked(self, frame: Any, module: str, name: str, *, is_clock: bool) -> None:
        """A function was called from ``frame``, which may be somebody's own code."""
        if not is_library_namespace(frame.f_globals):
            self._what = "the time" if is_clock else "what differs from process to process"
            self._asked = f"{module}.{name}"


def _is_without_a_time(name: str, frame: Any) -> bool:
    """Whether a function of ``time`` that is called now in ``frame`` says something of now. The
    number of arguments stands in the compiled code, behind the call."""
    if name not in _OF_A_GIVEN_TIME:
        return True
    return frame.f_code.co_code[frame.f_lasti + 1] == _OF_A_GIVEN_TIME[name]


_CREATE_RULESET = 444
_ADD_RULE = 445
_RESTRICT_SELF = 446
"""System calls of Landlock, on every processor."""
_READ_FILE = 1 << 2
_BENEATH = 1
_NO_NEW_PRIVILEGES = 38


def confine(places: Iterable[str | Path]) -> bool:
    """From now on this process can read only files in these places, whatever opens them. Returns
    whether the system can do that (Linux with Landlock); otherwise nothing changes."""
    if not sys.platform.startswith("linux"):
        return False
    libc = ctypes.CDLL(None, use_errno=True)
    call: Callable[..., int] = libc.syscall
    access_mask = ctypes.c_uint64(_READ_FILE)
    ruleset = call(
        _CREATE_RULESET, ctypes.byref(access_mask), ctypes.c_size_t(ctypes.sizeof(access_mask)), 0
    )
    if ruleset < 0:
        return False
    try:
        for place in dict.fromkeys(os.path.realpath(place) for place in places):
            _allow(call, ruleset, place)
        if libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0) != 0:
            return False
        return call(_RESTRICT_SELF, ruleset, 0) == 0
    finally:
        os.close(ruleset)


class _Beneath(ctypes.Structure):
    _pack_ = 1
    _layout_ = "ms"
    _fields_ = (("allowed", ctypes.c_uint64), ("parent", ctypes.c_int32))


def _allow(call: Callable[..., int], ruleset: int, place: str) -> None:
    try:
        handle = os.open(place, os.O_PATH | os.O_CLOEXEC)
    except OSError:  # it does not exist
        return
    try:
        rule = _Beneath(_READ_FILE, handle)
        call(_ADD_RULE, ruleset, _BENEATH, ctypes.byref(rule), 0)
    finally:
        os.close(handle)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
