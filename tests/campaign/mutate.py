"""Ways to damage a file: blindly, byte by byte, and with knowledge of its structure."""

import io
import json
import random
import re
import struct
import zipfile
from typing import Any

NUMBERS = (
    *(
        "0",
        "-1",
        "1",
        "0.5",
        "1e30",
        "-1e30",
        "1e-30",
        "nan",
        "inf",
        "-inf",
        "1e400",
        "4294967296",
        "-2147483649",
    ),
    *("9" * 400, "1" + "0" * 60, "abc", "", "0x10", "1_000", "18446744073709551616"),
)
BYTES = tuple(
    [struct.pack("<d", v) for v in (0.0, -1.0, 1e30, float("nan"), float("inf"), 1e-300)]
    + [struct.pack("<f", v) for v in (0.0, -1.0, 1e30, float("nan"), float("inf"))]
    + [struct.pack("<q", v) for v in (0, -1, 2**31, 2**32, 2**40, 2**62)]
    + [struct.pack("<i", v) for v in (0, -1, 1, 2**31 - 1, 2**24)]
)
VALUES: tuple[Any, ...] = (
    *(
        None,
        True,
        False,
        0,
        -1,
        1,
        0.5,
        1e30,
        -1e30,
        1e-30,
        2**40,
        10**39,
        "",
        "x",
        "nan",
        "../../x",
        "\0",
        [],
        {},
        [[]],
    ),
    *({"a": 1}, [1, 2, 3], ["a"], [[1, 2], [3]], [0] * 16, [None] * 16, [1e30] * 16, "a" * 5000),
)
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def mutated(
    data: bytes,
    name: str,
    rng: random.Random,
    others: list[bytes],
) -> bytes:
    """``data`` with one to three faults; ``name`` says what kind of file it is, ``others`` are
    spliced in."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        ways = [_bits, _cut, _cut_out, _twice, _splice, _overwrite, _overwrite]
        suffix = name.rsplit(".", 1)[-1].lower() if "." in name else name
        if suffix in ("json", "metadata"):
            ways = [_json, _json, _json, _json, _json_text, _json_text, _number, _number, *ways[:3]]
        elif suffix in ("txt", "csv", "log", "freiburg", "yaml", "depth_text"):
            ways = [_number, _number, _number, _number, _line, _line, *ways[:3]]
        elif suffix == "ply":
            ways = [_header, _header, _number, *ways]
        elif suffix in ("r3d", "zip", "pt"):
            ways = [_member, _member, _member, *ways]
        data = rng.choice(ways)(data, rng, others) if data else rng.randbytes(64)
    return data


def _bits(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice((1, 2, 8, 64))):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _cut(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    return data[: rng.randrange(len(data))]


def _cut_out(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    a = rng.randrange(len(data))
    return data[:a] + data[a + rng.choice((1, 4, 8, 100)) :]


def _twice(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    a = rng.randrange(len(data))
    b = a + rng.choice((1, 8, 64, 1000))
    return data[:b] + data[a:b] + data[b:]


def _splice(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    other = rng.choice(others)
    a = rng.randrange(len(data))
    b = rng.randrange(len(other) + 1)
    return data[:a] + other[b : b + rng.choice((16, 256, 4096))] + data[a:]


def _overwrite(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    value = rng.choice(BYTES)
    a = rng.randrange(min(len(data), rng.choice((64, 512, 10**9))))
    return data[:a] + value + data[a + len(value) :]


def _number(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    places = list(_NUMBER.finditer(data[:200_000]))
    if not places:
        return _bits(data, rng, others)
    match = rng.choice(places)
    return data[: match.start()] + rng.choice(NUMBERS).encode() + data[match.end() :]


def _line(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    lines = data.split(b"\n")
    i = rng.randrange(len(lines))
    j = rng.randrange(len(lines))
    way = rng.randrange(5)
    if way == 0:
        del lines[i]
    elif way == 1:
        lines.insert(j, lines[i])
    elif way == 2:
        lines[i], lines[j] = lines[j], lines[i]
    elif way == 3:
        lines[i] = b" ".join(lines[i].split()[:-1])
    else:
        lines.insert(
            i,
            rng.choice((b"\xff\xfe", b"# x", b"\0\0", b"a b c", b"1 2", b"\xc3\xa9", b" " * 10000)),
        )
    return b"\n".join(lines)


def _header(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    end = data.find(b"end_header")
    head = data[: max(end, 0)]
    rest = data[max(end, 0) :]
    if rng.randrange(2):
        kinds = (
            b"float",
            b"uchar",
            b"int",
            b"double",
            b"list uchar int",
            b"list uint float",
            b"int8",
            b"nothing",
        )
        return (
            head.replace(
                rng.choice((b"float", b"uchar", b"int")),
                rng.choice(kinds),
                rng.choice((1, 2, -1)),
            )
            + rest
        )
    return (_number if rng.randrange(2) else _line)(head or b"ply", rng, others) + rest


def _json(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """Another value, or none, at a random place of the document."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return _bits(data, rng, others)
    places = list(_places(document))
    if not places:
        return json.dumps(rng.choice(VALUES)).encode()
    holder, key = rng.choice(places)
    if rng.randrange(4) == 0:
        del holder[key]
    else:
        holder[key] = rng.choice(VALUES)
    return json.dumps(document).encode()


def _places(node: Any):
    children = (
        node.items()
        if isinstance(node, dict)
        else enumerate(node)
        if isinstance(node, list)
        else ()
    )
    for key, child in children:
        yield node, key
        yield from _places(child)


def _json_text(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """What a writer of JSON does not produce: equal keys, NaN, deep brackets, numbers without
    end."""
    way = rng.randrange(4)
    values = list(re.finditer(rb":\s*(-?[\d.eE+-]+|\"[^\"]*\")", data))
    if way == 0 or not values:
        deep = rng.choice((100, 2000, 100_000))
        return b'{"a":' * deep if rng.randrange(2) else b"[" * deep + b"]" * deep
    match = rng.choice(values)
    if way == 1:
        key = re.findall(rb'"[^"]*"\s*$', data[: match.start()])
        return (
            data[: match.end()] + b", " + (key[0] if key else b'"a"') + b": 1" + data[match.end() :]
        )
    value = rng.choice((b"NaN", b"Infinity", b"-Infinity", b"1e999", b"9" * 400, b"[" * 5000))
    return data[: match.start()] + b": " + value + data[match.end() :]


def _member(data: bytes, rng: random.Random, others: list[bytes]) -> bytes:
    """Damage inside an archive whose checksums are right."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {info.filename: archive.read(info) for info in archive.infolist()}
    except Exception:
        return _bits(data, rng, others)
    if not members:
        return data
    name = rng.choice([n for n in members if n.endswith((".pkl", "metadata"))] * 2 + list(members))
    way = rng.randrange(6)
    if way == 0:
        del members[name]
    elif way == 1:
        members[
            rng.choice(("../x", "/x", "a\0b", "metadata", "rgbd/99999999999.jpg", "rgbd/x.jpg"))
        ] = members[name]
    else:
        members[name] = mutated(members[name], name, rng, others)
    out = io.BytesIO()
    with zipfile.ZipFile(
        out, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    ) as made:
        for key, content in members.items():
            made.writestr(key, content)
    return out.getvalue()
