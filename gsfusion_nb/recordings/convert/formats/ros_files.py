"""Opening ROS 1 and ROS 2 bags with the pure-Python package ``rosbags``, and their messages."""

import contextlib
import io
import os
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from ....errors import SequenceError, SequenceNotFoundError
from ....files import open_regular, parsing, read_text
from .realsense_sdk import stream_of
from .unpacking import bounded, check_tables, most_bytes

METADATA = "metadata.yaml"
"""Of a ROS 2 bag: the file that names the others."""
_WHAT = "a file of a ROS bag"
_TF_MESSAGE = "geometry_msgs/TransformStamped[] transforms"
_LARGE_BYTES = 1 << 20


@contextmanager
def opened_bag(path: Path) -> Iterator[Any]:
    """A reader of the bag; its errors are raised as ``SequenceError``."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise SequenceError(
            f"{path} is a ROS bag, which needs the package rosbags: pip install 'gsfusion-nb[ros]'"
        ) from None
    if not path.exists():
        raise SequenceNotFoundError(
            f"{path} does not exist; expected a .bag file or the folder of a ROS 2 bag"
        )
    place = path.parent if path.suffix == ".db3" else path
    # ROS 2 bags before Iron do not contain their message types
    types = get_typestore(Stores.ROS2_HUMBLE)
    types.register(get_types_from_msg(_TF_MESSAGE, "tf2_msgs/msg/TFMessage"))
    files = [place] if place.is_file() else _files_of(place, path)
    for file in files:
        open_regular(file, _WHAT).close()
        if file.suffix == ".db3":
            check_tables(file)
    what = (
        "a ROS bag; if it is truncated or was not closed after recording, try 'rosbag reindex' "
        "or 'ros2 bag reindex'"
    )
    with (
        bounded(path, most_bytes(files)),
        parsing(path, what),
        AnyReader([_BagPath(place)], default_typestore=types) as reader,
    ):
        yield reader


def _files_of(folder: Path, given_file: Path) -> list[Path]:
    """The files that the bag in this folder consists of: whatever else lies there is no part of it.

    Raises:
        SequenceError: the given file belongs to no bag there, or the list of files cannot be read.
    """
    metadata = folder / METADATA
    what = f"the {METADATA} of a ROS 2 bag"
    if not metadata.exists() and _is_of_realsense(given_file):
        raise SequenceError(
            f"{given_file} is a recording of the RealSense SDK of 2026 or later, which is not "
            "read; "
            f"rs-convert -i {given_file.name} -p images/ writes its images, which are read, as "
            "are the .bag files of older SDKs"
        )
    if not metadata.exists():
        raise SequenceNotFoundError(
            f"{metadata} does not exist; a ROS 2 bag in sqlite needs it, and 'ros2 bag reindex' "
            "makes one"
        )
    with parsing(metadata, what):
        content = yaml.safe_load(read_text(metadata, what))
        names = [
            Path(name).name
            for name in content["rosbag2_bagfile_information"]["relative_file_paths"]
        ]
    if given_file.is_file() and given_file.name not in names:
        raise SequenceError(
            f"{metadata} does not name {given_file.name}; it is of the bag {', '.join(names)}"
        )
    return [metadata, *(folder / name for name in names)]


def _is_of_realsense(file: Path) -> bool:
    """Whether a database holds the topics of the RealSense SDK, which writes no
    ``metadata.yaml``."""
    address = f"{file.resolve().as_uri()}?mode=ro"
    names: list[str] = []
    with (
        contextlib.suppress(sqlite3.Error),
        contextlib.closing(sqlite3.connect(address, uri=True)) as database,
    ):
        names = [str(name) for (name,) in database.execute("SELECT name FROM topics LIMIT 1000")]
    return any(name.startswith("/device_") for name in names)


def message_of(reader: Any, connection: Any, raw: Any) -> tuple[Any, float]:
    """A message, and the metres per unit of depth that newer RealSense SDKs append to an image; 0
    where there is none.

    The SDK marks such an image by the frame "1", and its definition of the message does not have
    this number, a float32 behind the last byte of the pixels.
    """
    if stream_of(connection.topic) and connection.msgtype.endswith("/Image"):
        try:
            return reader.deserialize(raw, connection.msgtype), 0.0
        except Exception:  # of rosbags: the message is longer than its definition
            return reader.deserialize(raw[:-4], connection.msgtype), struct.unpack(
                "<f", bytes(raw[-4:])
            )[0]
    return reader.deserialize(raw, connection.msgtype), 0.0


class _BagPath(type(Path())):
    """A path whose file gives no more bytes than it has, also where a damaged bag asks for four
    gigabytes.

    Python's own files first take the memory that is asked for, and then see how much there is.
    """

    def open(self, mode: str = "r", *args: Any, **options: Any) -> Any:
        if mode != "rb":
            return super().open(mode, *args, **options)
        return _BagFile(open_regular(self, _WHAT).detach())


class _BagFile(io.BufferedReader):
    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > _LARGE_BYTES:
            size = max(
                0,
                min(size, os.fstat(self.fileno()).st_size - self.tell()),
            )
        return super().read(size)
