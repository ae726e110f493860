"""Packed chunks of ROS bags: a small file cannot ask for much memory, and rows of sqlite are
stored, not made."""

import bz2
import resource
import sqlite3
import struct

import lz4.frame
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from gsfusion_nb.errors import SequenceError
from gsfusion_nb.recordings.convert.formats import unpacking
from gsfusion_nb.recordings.convert.formats.ros_files import opened_bag

MOST = 1_000_000
TYPES = get_typestore(Stores.ROS1_NOETIC)


def zstd():
    return pytest.importorskip("backports.zstd")


PACKERS = {
    "bz2": (bz2.compress, bz2.BZ2Decompressor),
    "lz4": (lz4.frame.compress, lz4.frame.LZ4FrameDecompressor),
    "zstd": (lambda data: zstd().compress(data), lambda: zstd().ZstdDecompressor()),
}


@pytest.mark.parametrize("kind", PACKERS)
def test_streams_give_what_was_packed_and_no_more_than_the_limit(kind):
    pack, make = PACKERS[kind]
    data = bytes(range(256)) * 1000
    assert unpacking.unpack(pack(data), make, MOST, "a.bag") == data
    assert unpacking.unpack(pack(data) + pack(data[:7]), make, MOST, "a.bag") == data + data[:7]
    with pytest.raises(SequenceError, match=r"a\.bag: \d+ packed bytes unpack to more than 1 MB"):
        unpacking.unpack(pack(bytes(MOST + 1)), make, MOST, "a.bag")
    with pytest.raises(SequenceError, match="truncated"):
        unpacking.unpack(pack(data)[:-9], make, MOST, "a.bag")


def bag_of(path, n_bytes, packed):
    """A bag with one text of ``n_bytes`` zeros, in a packed chunk."""
    writer = Writer(path)
    writer.set_compression(packed)
    with writer:
        connection = writer.add_connection("/text", "std_msgs/msg/String", typestore=TYPES)
        writer.write(connection, 1, struct.pack("<I", n_bytes) + bytes(n_bytes))
    return path


def messages_of(path):
    with opened_bag(path) as reader:
        return [len(raw) for _, _, raw in reader.messages()]


@pytest.mark.parametrize("packed", list(Writer.CompressionFormat))
def test_a_bag_that_unpacks_to_far_more_than_its_size_is_refused(tmp_path, monkeypatch, packed):
    path = bag_of(tmp_path / "a.bag", 30_000_000, packed)
    assert messages_of(path) == [30_000_004]
    monkeypatch.setattr(unpacking, "LEAST_MEMORY_BYTES", MOST)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(SequenceError, match=r"a\.bag: \d+ packed bytes unpack to more than"):
        messages_of(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_the_unpackers_of_the_library_are_its_own_again(tmp_path):
    from rosbags.rosbag1 import reader

    before = dict(reader.decompressors)
    messages_of(bag_of(tmp_path / "a.bag", 10, Writer.CompressionFormat.BZ2))
    assert reader.decompressors == before


@pytest.mark.parametrize(
    ("sql", "sentence"),
    [
        (
            "CREATE VIEW messages AS SELECT 1 AS id, zeroblob(1000000000) AS data",
            "has the view 'messages'",
        ),
        (
            "CREATE TABLE messages (id INTEGER, data BLOB AS (zeroblob(1000000000)))",
            "computes the column 'data'",
        ),
        ("CREATE VIRTUAL TABLE messages USING fts5(data)", "which stores nothing"),
    ],
)
def test_rows_that_sqlite_makes_itself_are_refused(tmp_path, sql, sentence):
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as bag:
        bag.execute(sql)
    bag.close()
    with pytest.raises(SequenceError, match=sentence):
        unpacking.check_tables(path)


def test_tables_are_taken_and_other_files_named(tmp_path):
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as bag:
        bag.execute("CREATE TABLE messages (id INTEGER PRIMARY KEY, data BLOB NOT NULL)")
    bag.close()
    unpacking.check_tables(path)
    path.write_bytes(b"no database" * 100)
    with pytest.raises(SequenceError, match=r"a\.db3 is not readable as a ROS 2 bag in sqlite"):
        unpacking.check_tables(path)
