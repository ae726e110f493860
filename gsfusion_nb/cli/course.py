"""``gsfusion-nb course DIR``: the notebooks to work in; without a folder: how far you are.

``gsfusion-nb course export``: assignments; ``gsfusion-nb course times``: the times of a class.
"""

import contextlib
import json
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..config.option_help import parse_options
from ..files import write_file


@dataclass(frozen=True, kw_only=True)
class CourseOptions:
    """Copy the notebooks of the course into a folder, or show how far you are in them, and how long you worked.

    For lecturers: gsfusion-nb course times --help, gsfusion-nb course export --help.
    """

    folder: Annotated[Path | None, tyro.conf.Positional] = None
    """Where to write the notebooks, without solutions, and the documentation that they link to. What you have changed
    there is kept; a newer edition of such a notebook is written beside it."""
    open: bool = False
    """Then open the first one in JupyterLab."""

    json: bool = False
    """Print JSON."""
    reset: bool = False
    """Start the course again. Asks first; the file with your progress is renamed, not deleted."""
    yes: bool = False
    """With --reset: do not ask."""
    clock: Literal["on", "off", "forget"] | None = None
    """on, off: whether the notebooks note in your course file how long you work; forget: delete the times noted so
    far."""
    share: Path | None = None
    """Write a file for your lecturer: times, attempts and hints of each exercise; no code, no predictions, no dates."""


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Write the solved chapters as assignments for nbgrader or Otter-Grader: points, solution cells, hidden tests."""

    to: Literal["nbgrader", "otter"]
    """nbgrader: a course folder, for nbgrader generate_assignment. otter: notebooks for otter assign."""
    out: Path
    """New or empty folder."""
    chapters: Annotated[tuple[int, ...], tyro.conf.Positional] = ()
    """Numbers of chapters. Default: all."""
    notebooks: Path = Path("notebooks")
    """Folder of the solved chapters."""
    points: Path | None = None
    """TOML file with points: [difficulty] 1 = 2.0, or [exercise] psnr = 4."""
    seed: int = -1
    """Of the hidden inputs. Default: a new one."""


@dataclass(frozen=True, kw_only=True)
class TimesOptions:
    """The times of a class: n, quartiles of working time, tries and unfolded solutions by chapter and exercise."""

    files: tyro.conf.Positional[tuple[Path, ...]]
    """Course files of learners (gsfusion-nb course --share FILE), or folders of them."""
    csv: Path | None = None
    """Also write the table to this file, for a spreadsheet."""
    syllabus: Path | None = None
    """Also write the six-week syllabus to this file, with medians in place of estimates where 5 learners were timed."""
    pause_minutes: float = 10.0
    """A longer gap between two actions of a learner counts as a pause. 5 to 60."""


def times(arguments: list[str]) -> int:
    """The command ``gsfusion-nb course times``. Exit status: 0 done, 1 no file could be used."""
    from ..teaching.course_files import syllabus_page
    from ..teaching.kit import class_times
    from ..teaching.kit.syllabus import measured_page

    options = parse_options(TimesOptions, prog="gsfusion-nb course times", arguments=arguments)
    if not 5 <= options.pause_minutes <= 60:
        raise ValueError(f"--pause-minutes must be 5 to 60, got {options.pause_minutes:g}")
    if not options.files:
        raise ValueError("expected course files of learners, or a folder of them:  gsfusion-nb course times FOLDER")
    learners, problems = class_times.read_learners(options.files)
    for problem in problems:
        print(problem, file=sys.stderr)
    robots = [learner for learner in learners if learner.robot]
    people = [learner for learner in learners if not learner.robot]
    if not learners:
        print("No course file could be used.", file=sys.stderr)
        return 1
    if robots and people:
        print(f"not used: {', '.join(r.file for r in robots)}: typed by a program", file=sys.stderr)
    rows = class_times.class_rows(people or robots, 60 * options.pause_minutes)
    print(class_times.as_text(rows))
    whose = f"{len(people)} learner{'' if len(people) == 1 else 's'}" if people else f"{len(robots)} ROBOT, no learner"
    print(f"\n{whose}; a gap of more than {options.pause_minutes:g} minutes is a pause.")
    if options.csv is not None:
        class_times.write_csv(rows, options.csv)
        print(f"wrote {options.csv}")
    if options.syllabus is not None:
        if not people:
            raise ValueError("a robot's times are no learner's: no syllabus was written")
        text = measured_page(rows, len(people), options.pause_minutes, syllabus_page())
        write_file(options.syllabus, text)
        print(f"wrote {options.syllabus}")
    return 0


def export(arguments: list[str]) -> int:
    """The command ``gsfusion-nb course export``."""
    from ..teaching.grading.export import export_course
    from ..teaching.grading.marks import new_seed
    from ..teaching.grading.points import Points, read_points

    options = parse_options(ExportOptions, prog="gsfusion-nb course export", arguments=arguments)
    found = sorted(options.notebooks.glob("[0-9][0-9]_*.ipynb"))
    chosen = [p for p in found if not options.chapters or int(p.name[:2]) in options.chapters]
    missing = set(options.chapters) - {int(p.name[:2]) for p in chosen}
    if missing or not chosen:
        raise ValueError(f"there is no chapter {min(missing) if missing else ''} in {options.notebooks}")
    points = read_points(options.points) if options.points else Points()
    seed = options.seed if options.seed >= 0 else new_seed()
    for path in export_course(chosen, options.out, options.to, points=points, seed=seed):
        print(f"wrote {path}")
    return 0


def run(arguments: list[str]) -> int:
    """The command. Exit status: 0 done, 1 not confirmed."""
    if arguments[:1] == ["export"]:
        return export(arguments[1:])
    if arguments[:1] == ["times"]:
        return times(arguments[1:])
    from ..teaching import clock
    from ..teaching.course import read_course

    options = parse_options(CourseOptions, prog="gsfusion-nb course", arguments=arguments)
    if options.reset:
        return _reset(options.yes)
    if options.clock is not None:
        clock.switch(options.clock)
        said = {"on": "Times are noted, in your course file only.", "off": "No times are noted any more."}
        print(said.get(options.clock, "The times noted so far are deleted."))
        return 0
    if options.share is not None:
        return _share(options.share)
    if options.folder is not None:
        return _copy(options.folder, options.open)
    course = read_course()
    print(json.dumps(course.as_json(), indent=1) if options.json else course.as_table())
    return 0


def _reset(yes: bool) -> int:
    """Start again; a clock that was switched off stays off."""
    from ..teaching import clock, progress

    if not (yes or _confirmed()):
        print("Nothing was changed.")
        return 1
    stopped = False
    with contextlib.suppress(progress.CourseFileError):  # damaged: it is renamed, too
        stopped = clock.switched_off()
    kept = progress.reset()
    if stopped:
        clock.switch("off")
    print(f"The course starts again. Your progress so far is kept in {kept}" if kept else "There was no progress.")
    return 0


def _share(path: Path) -> int:
    """Write the file for the lecturer, and say what is in it."""
    from ..teaching.clock import SECTION
    from ..teaching.kit.class_times import shared
    from ..teaching.progress import read_section

    content = shared(read_section("exercises"), read_section(SECTION))
    write_file(path, json.dumps(content, indent=1) + "\n")
    print(
        f"wrote {path}: times, attempts and hints of {len(content['exercises'])} exercises, nothing else; look into it"
    )
    return 0


def _copy(folder: Path, open_it: bool) -> int:
    """Write the notebooks and say how to open them, or open them."""
    from ..teaching.course_files import FIRST, copy_for_learner

    done = copy_for_learner(folder)
    for notebook in done:
        if notebook.state != "unchanged":
            print(notebook)
    first = str(folder / FIRST)
    if not open_it:
        word = quoted(first, windows=sys.platform == "win32")
        print(f"{len(done)} notebooks are in {folder}. To open the first one: jupyter lab {word}")
        return 0
    return subprocess.call([sys.executable, "-m", "jupyter", "lab", first])


def quoted(path: str, *, windows: bool) -> str:
    """A path as one word of a command line; Windows knows double quotes only."""
    return subprocess.list2cmdline([path]) if windows else shlex.quote(path)


def _confirmed() -> bool:
    """Whether somebody at the keyboard types yes."""
    print(
        "Start the course again? Solved exercises, predictions and accepted functions are set aside. Type yes: ", end=""
    )
    sys.stdout.flush()
    return sys.stdin.readline().strip().lower() == "yes"
