"""``gsfusion-nb convert``: what a recording does not say is asked for at a terminal, one question
at a time."""

import dataclasses
import os
import sys
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from ..config.options import named, parse_value
from ..errors import ArgumentError, SequenceError
from ..files import read_object
from ..recordings.convert.conversion import ConvertReport
from ..recordings.convert.formats import FORMATS, known_formats, readable_layout
from ..recordings.convert.formats.unread import unread_recording
from ..recordings.convert.recording import ConvertOptions, OptionNeeded
from ..recordings.convert.run import convert

CONVERTED = Path("converted")
"""Where ``mappable`` writes, below the current folder."""


def convert_or_ask(
    source: str | Path,
    out: str | Path,
    *,
    format: str = "auto",
    options: ConvertOptions | None = None,
) -> ConvertReport:
    """``convert`` with a progress bar; what a recording does not say is asked for, if somebody is
    at a terminal, and once more where the recording cannot be read with the answer.

    Raises:
        OptionNeeded: nobody can be asked; the message names the option that answers the question.
        SequenceError, FileExistsError, KeyError: as ``convert``.
    """
    options = options or ConvertOptions()
    question = None
    while True:
        try:
            return convert(source, out, format=format, options=options, progress=True)
        except OptionNeeded as needed:
            if not (sys.stdin.isatty() and sys.stdout.isatty()):
                raise
            question = options, needed
        except SequenceError as e:
            if question is None:
                raise
            print(e)
        options = _with_answer(*question)


def _with_answer(options: ConvertOptions, need: OptionNeeded) -> ConvertOptions:
    """The options with the answer of a person; asked again until it is one."""
    print(need.question)
    for n, choice in enumerate(need.choices, 1):
        print(f"  {n}: {choice}")
    while True:
        answer = input(f"--{need.option.replace('_', '-')} ").strip()
        if answer.isdecimal() and 1 <= int(answer) <= len(need.choices):
            answer = need.choices[int(answer) - 1]
        try:
            is_text = isinstance(getattr(options, need.option), str)
            return dataclasses.replace(
                options, **{need.option: answer if is_text else parse_value(answer)}
            )
        except ValueError as e:
            print(e)


def mappable(source: str) -> tuple[str, bool]:
    """A folder that can be mapped: ``source`` itself, or what a recording of another program was
    converted to.

    Returns:
        The folder, and whether its camera has to be tracked because the recording holds no poses.

    Raises:
        SequenceError, OptionNeeded: as ``convert_or_ask``.
    """
    path = Path(source).expanduser()
    if readable_layout(path):
        return source, False
    if not any(f.recognise(path) for f in FORMATS.values() if path.exists()):
        if advice := unread_recording(path):
            raise SequenceError(advice)
        return source, False
    folder = CONVERTED / path.resolve().name
    report_file = folder / "conversion.json"
    report = read_object(report_file, "the report of a conversion") if report_file.is_file() else {}
    if not report:
        print(f"{path} is converted to {folder} first")
        try:
            made = convert_or_ask(path, folder)
        except OptionNeeded as e:
            option = e.option.replace("_", "-")
            raise SequenceError(
                f"{e}; before mapping: gsfusion-nb convert {path} {folder} --{option} ..."
            ) from None
        print(made)
    elif Path(str(report.get("source", ""))).resolve() != path.resolve():
        raise SequenceError(
            f"{folder} is another recording; convert {path} to another folder, with gsfusion-nb "
            "convert"
        )
    else:
        if changed := _changed_since(path, report_file):
            raise SequenceError(
                f"{changed} has changed since {path} was converted to {folder}; remove that folder "
                "to convert it again, or give it to go on with what was converted"
            )
        print(f"{path} was converted to {folder} before; remove that folder to convert it again")
        notes = report.get("notes")
        for note in notes if isinstance(notes, list) else ():
            print(f"  note: {note}")
    return str(folder), not (folder / "poses.txt").is_file()


def _changed_since(recording: Path, report_file: Path) -> Path | None:
    """The first file of a recording that was written after its conversion, or None. Hidden files,
    pages of ``check`` and folders that commands write below the recording do not count."""
    converted = report_file.stat().st_mtime
    if recording.is_file():
        return recording if recording.stat().st_mtime > converted else None
    for folder, names, files in os.walk(recording):
        written_here = {CONVERTED.name, "runs"}
        names[:] = sorted(
            name for name in names if not _is_hidden(name) and name not in written_here
        )
        for name in sorted(files):
            file = Path(folder, name)
            counts = not _is_hidden(name) and file.suffix != ".html" and file.is_file()
            if counts and file.stat().st_mtime > converted:
                return file
    return None


def _is_hidden(name: str) -> bool:
    """Whether a file manager hides it; many leave such files of their own in a folder."""
    return name.startswith(".")


@dataclass(frozen=True, kw_only=True)
class ConvertCommand:
    """Write a recording in another format as a sequence that can be checked and mapped: [FORMAT]
    SOURCE OUT. Frames are written one by one, and OUT appears when all is done."""

    words: Annotated[
        tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[FORMAT] SOURCE OUT")
    ] = named(MISSING, lambda: sorted(FORMATS))
    """SOURCE: the file or folder of the recording. OUT: a new folder. FORMAT: recognised
    automatically if omitted."""
    options: Annotated[ConvertOptions, tyro.conf.arg(name="")] = field(
        default_factory=ConvertOptions
    )


def run(options: ConvertCommand) -> int:
    """The command. Exit status 0: the recording is converted.

    Raises:
        ValueError: other arguments than [FORMAT] SOURCE OUT.
    """
    if not 2 <= len(options.words) <= 3:
        format_lines = "\n".join(
            f"  {name:<10} {looks_for}" for name, looks_for in known_formats().items()
        )
        raise ArgumentError(
            f"expected [FORMAT] SOURCE OUT; the formats and what they look for:\n{format_lines}"
        )
    *format, source, folder = options.words
    report = convert_or_ask(
        source, folder, format=format[0] if format else "auto", options=options.options
    )
    print(report)
    return 0
