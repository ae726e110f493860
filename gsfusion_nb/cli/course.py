"""``gsfusion-nb course``: how far you are in the notebooks."""

import json
import sys
from dataclasses import dataclass

from ..config.option_help import parse_options


@dataclass(frozen=True, kw_only=True)
class CourseOptions:
    """Show how far you are in the course: exercises solved and predictions made, by chapter."""

    json: bool = False
    """Print JSON."""
    reset: bool = False
    """Start the course again. Asks first; the file with your progress is renamed, not deleted."""
    yes: bool = False
    """With --reset: do not ask."""


def run(arguments: list[str]) -> int:
    """The command. Exit status: 0 done, 1 not confirmed."""
    from ..teaching import progress
    from ..teaching.course import read_course

    options = parse_options(CourseOptions, prog="gsfusion-nb course", arguments=arguments)
    if options.reset:
        if not (options.yes or _confirmed()):
            print("Nothing was changed.")
            return 1
        kept = progress.reset()
        print(f"The course starts again. Your progress so far is kept in {kept}" if kept else "There was no progress.")
        return 0
    course = read_course()
    print(json.dumps(course.as_json(), indent=1) if options.json else course.as_table())
    return 0


def _confirmed() -> bool:
    """Whether somebody at the keyboard types yes."""
    print(
        "Start the course again? Solved exercises, predictions and accepted functions are set aside. Type yes: ", end=""
    )
    sys.stdout.flush()
    return sys.stdin.readline().strip().lower() == "yes"
