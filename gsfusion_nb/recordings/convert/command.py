"""``gsfusion-nb convert``: the options of the command line, and what they start."""

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from ...config.option_help import parse_options
from .detect import known_formats
from .options import ConvertOptions
from .run import ConvertReport, convert


@dataclass(frozen=True, kw_only=True)
class ConvertCommand:
    """Write a recording in another format as a sequence that can be checked and mapped: [FORMAT] SOURCE OUT. Frames
    are written one by one; an interrupted conversion continues when the command is repeated."""

    words: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[FORMAT] SOURCE OUT")]
    """FORMAT: colmap, icl_nuim, nerfstudio, open3d, record3d, ros, scannet or tum; recognised automatically if omitted.
    SOURCE: the file or folder of the recording. OUT: a new folder."""
    options: Annotated[ConvertOptions, tyro.conf.arg(name="")] = field(default_factory=ConvertOptions)


def run(arguments: list[str]) -> ConvertReport:
    """Convert as the arguments say.

    Raises:
        ValueError: other arguments than [FORMAT] SOURCE OUT.
    """
    command = parse_options(ConvertCommand, prog="gsfusion-nb convert", arguments=arguments)
    words = command.words
    if not 2 <= len(words) <= 3:
        listed = "\n".join(f"  {name:<10} {looks_for}" for name, looks_for in known_formats().items())
        raise ValueError(f"expected [FORMAT] SOURCE OUT; the formats and what they look for:\n{listed}")
    *format, source, out = words
    return convert(source, out, format=format[0] if format else "auto", options=command.options, progress=True)
