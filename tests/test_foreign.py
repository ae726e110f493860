"""Files of other people and programs: read in one place, within limits, with sentences."""

import ast
import os
import struct
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsfusion_nb.data.recorded.images import check_image_size, decode_rgb, image_size
from gsfusion_nb.errors import BadFrameError, SequenceError, SequenceNotFoundError
from gsfusion_nb.files import (
    inflate,
    open_archive,
    open_regular,
    parse_json,
    parsing,
    read_bytes,
    read_member,
    read_object,
    read_text,
)

PACKAGE = Path(__file__).resolve().parents[1] / "gsfusion_nb"
BY_HAND = {
    "read_text",
    "read_bytes",
    "imread",
    "imdecode",
    "loadtxt",
    "genfromtxt",
    "fromfile",
    "memmap",
}
OF_MODULE = {
    **dict.fromkeys(
        ("json.load", "json.loads", "np.load", "torch.load", "zipfile.ZipFile", "tarfile.open"), ""
    ),
    **dict.fromkeys(
        ("zlib.decompress", "bz2.decompress", "gzip.open", "gzip.decompress", "PlyData.read"), ""
    ),
}
ALLOWED = {
    **dict.fromkeys(
        (
            "files/archives.py",
            "files/atomic.py",
            "files/foreign.py",
            "files/hashes.py",
            "files/json_objects.py",
        ),
        "the place",
    ),
    "backends/offers.py": "source files of this package",
    "course/source_lines.py": "source files of this package",
    **dict.fromkeys(
        ("viewer/front_end.py", "compare/table_file.py", "compare/studies.py"),
        "files of this package",
    ),
    "resources/process.py": "/proc/meminfo and /proc/self/status",
    "compare/bench/timing.py": "/proc/cpuinfo",
    "cli/__init__.py": "the null device, and a file of this package",
    "course/copies.py": "pages of this project",
    "compare/command.py": "a table it has just written",
    "compare/map_scene.py": "plain values of its own",
    "compare/spec.py": "plain values of its own",
    "compare/program.py": "source files of this package, which only go into a hash",
    "compare/fresh_check.py": "a job that its own caller has written",
    "seeding/beside.py": "modules that a rule imports, and so executes",
    "code_keys/key.py": "modules that a rule imports, which only go into a hash",
    "code_keys/installed.py": "lists and files of installed packages, which only go into a hash",
    "compare/executors.py": "a picture it has just drawn",
    "data/recorded/images.py": "decodes after the header was looked at",
    "data/room/image_cache.py": "pictures of its own, from bytes of a limited size",
    "recordings/convert/depth_files.py": "an array that is mapped, and so is not larger than its "
    "file",
    "recordings/convert/formats/ros_files.py": "a file that gives no more bytes than it has",
    "recordings/convert/formats/unpacking.py": "a file that gives no more bytes than it may have",
    "recordings/unpack.py": "unpacking into a new folder within a limit",
    "course/grading/answering.py": "the null device",
    "course/grading/data.py": "messages of a limited size, in which no value is more than data",
    "course/grading/journal.py": "marks that it has written",
    "course/grading/library.py": "source files of this package",
    "course/grading/process.py": "files of /proc",
    "viz/steppers/recording.py": "source files of this package",
    "viz/growing_page.py": "a page that it has written",
    "export/checkpoint_store.py": "tensors and plain values whose checksum is right",
    "runs/run_folder.py": "text of a checkpoint whose checksum is right, and "
    "/proc/sys/kernel/random/boot_id",
    "export/ply.py": "a reader of its own",
    "export/tsdf_file.py": "arrays without objects",
    "data/adjust/extra_files.py": "an array that is mapped, and an image that was decoded before",
    "runs/map_state.py": "tensors and plain values within a limit of memory",
}


def opened_by_hand(path: Path) -> list[str]:
    """Calls that read a file, or unpack bytes, without the limits of ``files``."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        f = node.func
        name = f.attr if isinstance(f, ast.Attribute) else f.id if isinstance(f, ast.Name) else ""
        dotted = (
            f"{f.value.id}.{f.attr}"
            if isinstance(f, ast.Attribute) and isinstance(f.value, ast.Name)
            else name
        )
        of_class = dotted in ("self.read_text", "files.read_text")
        text = isinstance(f, ast.Attribute) and name in BY_HAND and not of_class
        modes = [
            a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)
        ]
        opens = (
            name == "open"
            and not dotted.startswith(("OpenEXR", "tarfile", "webbrowser"))
            and not set("wax") & set("".join(modes))
        )
        if text or dotted in OF_MODULE or opens:
            found.append(f"line {node.lineno}: {dotted}")
    return found


def test_no_file_of_others_is_opened_by_hand():
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        if name not in ALLOWED and (calls := opened_by_hand(path)):
            found[name] = calls
    assert found == {}, "read through gsfusion_nb/files"
    assert [name for name in ALLOWED if not opened_by_hand(PACKAGE / name)] == [], (
        "no longer needed"
    )


def test_the_scan_finds_what_it_looks_for(tmp_path):
    lines = [
        "import json, numpy as np",
        "path.read_text()",
        "json.load(f)",
        "np.load(p)",
        "open(p)",
        "p.open('rb')",
    ]
    (tmp_path / "a.py").write_text("\n".join([*lines, "read_text(p, 'x')", "p.open('w')"]))
    assert [call.split(":")[0] for call in opened_by_hand(tmp_path / "a.py")] == [
        f"line {n}" for n in range(2, 7)
    ]


def test_pipes_devices_and_folders_are_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    (tmp_path / "circle").symlink_to(tmp_path / "circle")
    for name in ("pipe", "zero"):
        with pytest.raises(
            SequenceError, match=rf"{name} is a pipe or device, not a plain file; expected lines"
        ):
            read_bytes(tmp_path / name, "lines")
    with pytest.raises(SequenceError, match=r"is a folder, not a plain file"):
        read_text(tmp_path, "lines")
    with pytest.raises(SequenceError, match=r"circle cannot be read"):
        open_regular(tmp_path / "circle", "lines")
    with pytest.raises(SequenceError, match=r"cannot be read \(embedded null byte\)"):
        open_regular("a\0b", "lines")
    with pytest.raises(SequenceNotFoundError, match=r"nowhere does not exist; expected lines"):
        read_bytes(tmp_path / "nowhere", "lines")


def test_limits(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", "text", at_most=5) == b"12345"
    with pytest.raises(SequenceError, match="is larger than"):
        read_bytes(tmp_path / "a", "text", at_most=4)
    packed = zlib.compress(bytes(100_000))
    assert inflate(packed, "x", at_most=100_000) == bytes(100_000)
    with pytest.raises(BadFrameError, match="unpacks to more than the 99999 bytes"):
        inflate(packed, "x", at_most=99_999)
    with pytest.raises(BadFrameError, match="it is truncated"):
        inflate(packed[:-6], "x", at_most=100_000)
    with zipfile.ZipFile(tmp_path / "z", "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("m", bytes(1000))
    with open_archive(tmp_path / "z", "an archive") as archive:
        assert read_member(archive, "m", "z", at_most=1000) == bytes(1000)
        with pytest.raises(BadFrameError, match="m unpacks to 1000 bytes; expected at most 999"):
            read_member(archive, "m", "z", at_most=999)


def raising(error):
    with parsing("a.bag", "a bag"):
        raise error


@pytest.mark.parametrize(
    "error", [AssertionError(), struct.error("x"), IndexError("y"), RecursionError("deep")]
)
def test_errors_of_parsers_are_sentences(error):
    with pytest.raises(SequenceError, match=r"a\.bag is not readable as a bag \("):
        raising(error)


def test_sentences_pass_and_memory_has_its_own():
    with pytest.raises(BadFrameError, match=r"^mine$"):
        raising(BadFrameError("mine"))
    with pytest.raises(SequenceError, match="asks for more memory"):
        raising(MemoryError())


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('{"a":\n  NaN}', "NaN is not a finite number"),
        ('["NaN", -Infinity]', "-Infinity is not a finite number"),
        ("[1e999]", "1e999 is not a finite number"),
        ('{"a": 1,\n "b": {"a": 2, "a": 3}}', "the key 'a' appears twice"),
        ('{"\\u0061": 1, "a": 2}', "the key 'a' appears twice"),
        (f"[{'9' * 400}]", "9 is not a finite number"),
        (f"[{'9' * 5000}]", "9 is not a finite number"),
        ("[" * 100_000, "recursion"),
        ('{"a": [1, 2}', "line 1 column 12"),
    ],
)
def test_json_that_is_ambiguous_or_no_number(text, fault):
    with pytest.raises(
        SequenceError, match=rf"^a\.json is not valid JSON \(.*{fault}.*\); expected settings$"
    ):
        parse_json(text, "a.json", "settings")


def test_json_in_order(tmp_path):
    (tmp_path / "a.json").write_text(
        '\ufeff{"a": [1, 2.5, "x, NaN: {[", null, true], "b": {"a": -1e-3}}', encoding="utf-8"
    )
    assert read_object(tmp_path / "a.json", "it") == {
        "a": [1, 2.5, "x, NaN: {[", None, True],
        "b": {"a": -1e-3},
    }
    (tmp_path / "b.json").write_text("[]")
    with pytest.raises(SequenceError, match=r"b\.json must hold a JSON object \(it\), got a list"):
        read_object(tmp_path / "b.json", "it")
    assert parse_json("[" * 64 + "]" * 64, "x", "y")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp", ".pgm"])
def test_the_size_of_an_image_is_known_from_its_header(suffix):
    image = np.random.default_rng(0).integers(
        0,
        255,
        (31, 47) if suffix == ".pgm" else (31, 47, 3),
        np.uint8,
    )
    data = cv2.imencode(suffix, image)[1].tobytes()
    assert image_size(data) == (47, 31)
    for n in range(
        0,
        len(data),
        max(1, len(data) // 200),
    ):
        assert image_size(data[:n]) in (None, (47, 31))


def test_an_image_that_claims_a_billion_pixels_is_not_decoded():
    header = struct.pack(">IIBBBBB", 30000, 30000, 8, 2, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR" + header + b"IEND\xaeB`\x82"
    with pytest.raises(BadFrameError, match=r"a\.png cannot be decoded"):
        decode_rgb(data, "a.png")


def test_the_size_of_an_openexr_file_is_that_of_its_largest_part():
    head = b"v/1\x01" + struct.pack("<I", 2)
    sizes = ((30, 20), (7000, 6000))
    parts = [
        b"dataWindow\0box2i\0" + struct.pack("<iiiii", 16, 5, 7, 4 + w, 6 + h) for w, h in sizes
    ]
    assert image_size(head) is None
    assert image_size(head + parts[0]) == (30, 20)
    with pytest.raises(BadFrameError, match=r"d\.exr claims 7000x6000"):
        check_image_size(head + parts[0] + parts[1], "d.exr", "depth")
