"""Opening a sequence by path or name, whatever its layout, and a hash of everything that a run
reads of it."""

import contextlib
import dataclasses
import functools
import hashlib
import importlib
import inspect
import pkgutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from ..checks import check_name, shown
from ..config import DataConfig
from ..errors import ArgumentError, SequenceError, SequenceNotFoundError
from ..extensions import Extension, extensions, warn_once
from ..files import UNREADABLE, file_hashes, noting_files
from . import readers
from .adjust.extra_files import ExtraFiles
from .adjust.repair import RepairedSequence, as_read
from .adjust.selection import ExtraOf, FrameSubset, OpenedSequence, apply_options
from .recorded.files import missing
from .recorded.recorded_sequence import Layout, RecordedSequence


def known_layouts() -> dict[str, Layout]:
    """Layouts by name, in the order in which they are tried: ``LAYOUT`` of every file in
    ``readers``, and those that installed packages add (``extensions``).

    One that cannot be loaded is left out, and a warning says why.
    """
    names = sorted(module.name for module in pkgutil.iter_modules(readers.__path__))
    layouts: dict[str, Layout] = {
        name: importlib.import_module(f"{readers.__name__}.{name}").LAYOUT for name in names
    }
    for name, extension in extensions("readers", built_in=("auto", "room", *names)).items():
        layout, problem = _layout_of(extension)
        if layout is None:
            warn_once(problem)
        else:
            layouts[name] = layout
    return layouts


@functools.cache
def _layout_of(extension: Extension) -> tuple[Layout | None, str]:
    """The layout that an installed package adds, loaded once; or None, and why there is none."""
    try:
        layout = extension.load()
    except ArgumentError as e:
        return None, str(e)
    if not isinstance(layout, Layout):
        return None, f"expected a Layout, got {shown(layout)}: {extension.in_words}"
    return layout, ""


_CONVERT = (
    ". A ROS bag and recordings of other programs are converted to a folder first: "
    "gsfusion-nb convert SOURCE FOLDER"
)


def open_sequence(
    path_or_name: str | Path,
    *,
    format: str = "auto",
    data: DataConfig | None = None,
    extra: ExtraOf | Mapping[str, str] | None = None,
    **options: Any,
) -> OpenedSequence:
    """Open a sequence: the frames to map are ``.mapping``, those held out for evaluation are
    ``.held_out``.

    Args:
        path_or_name: Folder of a sequence, or "room", the built-in scene (a folder of that name:
            "./room").
        format: "auto" recognises the layout by its files; or the name of a file in ``readers``.
        data: Size, range, depth limits, held-out frames.
        extra: A function from a frame, at its recorded size, to further images of it by name:
            labels, uncertainties, or anything [H, W, ...]. They become ``frame.extra``, are resized
            with the frame, and reach seeding rules and losses of your own. Or name -> pattern of
            the files in the folder: ``{"class": "labels/{index:06d}.png"}`` (``ExtraFiles``).
        options: Keyword arguments of the layout's reader, such as ``undistort`` of ``tum``,
            ``register`` of ``seven_scenes`` or ``split`` of ``scannetpp``.

    Raises:
        SequenceNotFoundError: no such folder, or one of its files is missing.
        SequenceError: the folder fits no layout (the message lists what each layout looks for), or
            its content is invalid.
        KeyError: unknown format.
        ValueError: an option that the layout's reader does not have; or files of further images for
            a sequence without files.
    """
    check_name("format", format, ("auto", "room", *known_layouts()))
    if format == "room" or (format == "auto" and str(path_or_name) == "room"):
        from .room import room

        # rendered at the wanted size, not resized to it
        if data is not None and data.width and data.height:
            options = {"width": data.width, "height": data.height, **options}
        _check_options("room", room, options)
        if isinstance(extra, Mapping):
            raise ArgumentError("files of further images need a recording in a folder, not room")
        source: Any = room(**options)
        return apply_options(source, data, extra)
    path = Path(path_or_name).expanduser()
    if not path.is_dir():
        raise SequenceNotFoundError(
            f"{path} is not a folder; expected one that holds a sequence, or the name of a "
            "built-in: room" + (_CONVERT if path.exists() else "")
        )
    name = detect_layout(path) if format == "auto" else format
    reader = known_layouts()[name].read
    _check_options(name, reader, options)
    with noting_files() as read_from:
        recording = reader(path, **options)
    if isinstance(recording, RecordedSequence):
        recording = dataclasses.replace(recording, read_from=tuple(dict.fromkeys(read_from)))
    if isinstance(extra, Mapping):
        if not isinstance(recording, RecordedSequence):
            raise ArgumentError(f"files of further images need a recording with images, not {name}")
        stems = [file.stem for file in recording.rgb_files]
        extra = ExtraFiles(folder=path, patterns=dict(extra), stems=stems)
    return apply_options(recording, data, extra)


def _check_options(
    name: str,
    reader: Callable[..., Any],
    options: Mapping[str, Any],
) -> None:
    names = [
        p.name for p in inspect.signature(reader).parameters.values() if p.kind is p.KEYWORD_ONLY
    ]
    if unknown := [option for option in options if option not in names]:
        raise ArgumentError(
            f"{name} has no option {', '.join(unknown)}; it has: {', '.join(names) or 'none'}"
        )


def detect_layout(path: str | Path) -> str:
    """Name of the first layout whose files are all there.

    Raises:
        SequenceError: none; the message lists for each layout what it looks for and what is
            missing.
    """
    path = Path(path)
    layouts = known_layouts()
    lacking = {
        name: missing(layout.locate(path), layout.looks_for) for name, layout in layouts.items()
    }
    for name, parts in lacking.items():
        if not parts:
            return name
    nearest = sorted(
        layouts,
        key=lambda name: len(lacking[name]) / len(layouts[name].looks_for),
    )
    descriptions = []
    for name in nearest:
        files_text = ", ".join(layouts[name].looks_for)
        descriptions.append(f"{name}: {files_text} (missing {', '.join(lacking[name])})")
    raise SequenceError(
        f"{path} fits no known layout; looked for {'; '.join(descriptions)}{_CONVERT}"
    )


def sequence_fingerprint(sequence: OpenedSequence) -> str:
    """A hash of an open sequence: frames to map, frames held out, camera, poses, and the content of
    all their images.

    Of a recording on disk the files are hashed, those with poses and intrinsics too; of any other
    sequence the pixels of every frame, unless its source has a ``content``, a text that decides its
    frames (the built-in room).
    """
    digest = hashlib.blake2b(digest_size=16)
    views = (sequence.mapping, sequence.held_out)
    for view in views:
        digest.update(
            repr((view.positions, view.camera, view.depth_min_m, view.depth_max_m)).encode()
        )
        for i in range(len(view)):
            digest.update(_pose_bytes(view, i))
    source = sequence.source
    if isinstance(source, RepairedSequence):
        digest.update(repr(source.repair).encode())
    source = as_read(source)
    if isinstance(source, RecordedSequence):
        file_settings = (source.depth_scale, source.depth_invalid, source.fit_sizes)
        hashes = list(data_files(sequence).values())
        digest.update(repr((file_settings, hashes)).encode())
        if source.rectification is not None:  # what it does to the images shows in one of them
            _add_pixels(digest, sequence.mapping, at_most=1)
    elif content := getattr(source, "content", ""):
        digest.update(content.encode())
    else:
        for view in views:
            _add_pixels(digest, view)
    return digest.hexdigest()


def data_files(sequence: OpenedSequence) -> dict[str, str]:
    """Path -> hash of each file that a run on ``sequence`` reads; empty for a sequence that is not
    on disk."""
    source = as_read(sequence.source)
    if not isinstance(source, RecordedSequence):
        return {}
    positions = [*sequence.mapping.positions, *sequence.held_out.positions]
    images = [file for i in positions for file in (source.rgb_files[i], source.depth_files[i])]
    extra = sequence.mapping.extra
    others = extra.files(positions) if isinstance(extra, ExtraFiles) else []
    return file_hashes([*source.read_from, *images, *others])


def frame_fingerprints(sequence: OpenedSequence) -> list[str]:
    """A hash of each picture of the recording from the first to the last frame of ``sequence``,
    also of those between that it leaves out; without repetitions.

    Two sequences that have a hash in common show the same walk, at least in part. Size, name,
    range, stride, held-out frames and corrections do not matter. Of a recording on disk the files
    of its colour images are hashed, of any other sequence the pixels, unless its source has
    ``moments``, texts that name what its frames show (the built-in room).
    """
    positions = [*sequence.mapping.positions, *sequence.held_out.positions]
    if not positions:
        return []
    walk = range(min(positions), max(positions) + 1)
    source = as_read(sequence.source)
    if isinstance(source, RecordedSequence):
        hash_of = file_hashes(source.rgb_files[i] for i in walk)
        digests = [digest for digest in hash_of.values() if digest != UNREADABLE]
    elif moments := getattr(source, "moments", None):
        digests = [hashlib.blake2b(text.encode()).hexdigest() for text in moments(walk)]
    else:
        digests = list(_pixel_hashes(source, walk))
    return list(dict.fromkeys(digest[:16] for digest in digests))


def _pixel_hashes(source: Any, walk: Iterable[int]) -> Iterator[str]:
    """Hash of the colours of each frame that can be read."""
    for i in walk:
        with contextlib.suppress(SequenceError):
            pixels = source[i].colour.cpu().contiguous().numpy()
            yield hashlib.blake2b(pixels.tobytes()).hexdigest()


def _pose_bytes(view: FrameSubset, i: int) -> bytes:
    try:
        return view.pose(i).to("cpu", torch.float64).contiguous().numpy().tobytes()
    except SequenceError:
        return b"no pose"


def _add_pixels(digest: Any, view: FrameSubset, at_most: int = -1) -> None:
    """Add the images of the first ``at_most`` frames that can be read; of all by default."""
    for i in range(len(view)):
        try:
            frame = view[i]
        except SequenceError:
            digest.update(b"no frame")
            continue
        for pixels in (frame.colour, frame.depth_m):
            digest.update(pixels.cpu().contiguous().numpy().tobytes())
        at_most -= 1
        if at_most == 0:
            return
