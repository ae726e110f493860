"""What crosses between a submission and its judge is data, whatever a submission sends."""

import json
import pickle
import struct

import numpy as np
import pytest
import torch

from gsfusion_nb.course.grading.data import LENGTH, DataError, cut, decode, encode
from gsfusion_nb.course.grading.pickled import Incoming, Outgoing
from gsfusion_nb.course.seeding import wall_context
from gsfusion_nb.types import Camera, Seeds

CAMERA = Camera(width=3, height=2, fx=1.0, fy=1.0, cx=1.5, cy=1.0)
VALUES = {
    "plain": [None, True, 3, -2.5, "text", 1 + 2j, ..., (1, [2]), {3}, frozenset({4}), b"5"],
    "tensors": [
        torch.arange(6.0).reshape(2, 3).T,
        torch.zeros(0, 3),
        torch.tensor(7),
        torch.tensor([True, False]),
        torch.randn(3).bfloat16(),
        torch.tensor([1 + 2j]).conj(),
    ],
    "keys": {1: "a", (2, 3): "b", "c": {}},
    "array": np.arange(4, dtype=np.int16),
    "camera": CAMERA,
}


def crossed(value):
    return decode(bytearray(encode(value)[LENGTH.size :]))


def test_values_arrive_as_they_were():
    back = crossed(VALUES)
    assert back["plain"] == VALUES["plain"]
    for new, old in zip(back["tensors"], VALUES["tensors"], strict=True):
        assert new.dtype == old.dtype
        assert torch.equal(new, old)
    assert back["keys"] == VALUES["keys"]
    assert np.array_equal(back["array"], VALUES["array"])
    assert back["camera"] == CAMERA
    assert len(crossed(Seeds.empty())) == 0


@pytest.mark.parametrize("kind", ["set", "frozenset", "dict"])
def test_keys_with_equal_hashes_take_no_hours(kind):
    keys = [number * (2**61 - 1) for number in range(100_000)]  # all have the hash 0
    assert len({hash(key) for key in keys}) == 1
    content = [[key, 0] for key in keys] if kind == "dict" else keys
    for value in ({kind: content}, {"list": [0, {"tuple": [{kind: content}]}]}):
        with pytest.raises(DataError, match="more than 20,000 entries"):
            decode(message({"value": value, "sizes": []}))


def test_an_object_leaves_only_its_name():
    class Liar:
        def __eq__(self, other):
            return True

    assert type(crossed(Liar())).__name__ == "Liar"
    assert crossed(Liar()) != 3


def message(head, *buffers):
    text = json.dumps(head).encode()
    return struct.pack("<Q", len(text)) + text + b"".join(buffers)


TENSOR = {"tensor": 0, "dtype": "float32", "shape": [2]}


@pytest.mark.parametrize(
    "document",
    [
        b"",
        b"12345678",
        pickle.dumps(VALUES["plain"]),
        encode(VALUES)[LENGTH.size : -1],
        encode(VALUES)[LENGTH.size :] + b"1",
        message({"value": [1], "sizes": []}),
        message({"value": TENSOR, "sizes": [4]}, b"1234"),
        message({"value": TENSOR | {"shape": [1 << 40]}, "sizes": [0]}),
        message({"value": TENSOR | {"shape": [-1, -1]}, "sizes": [8]}, b"12345678"),
        message({"value": TENSOR | {"dtype": "quint8"}, "sizes": [8]}, b"12345678"),
        message({"value": TENSOR, "sizes": [-8]}),
        message({"value": {"object": "Frame", "fields": {"dict": []}}, "sizes": []}),
        message({"value": {"object": "Camera", "fields": {"dict": [["width", -1]]}}, "sizes": []}),
        message({"value": {"dict": [[{"list": []}, 1]]}, "sizes": []}),
        message({"value": {"list": [], "dict": []}, "sizes": []}),
        message({"value": 1, "sizes": 7}),
        struct.pack("<Q", 200_000) + b'{"value":' + b'{"list":[' * 20_000 + b"]}" * 20_000,
        struct.pack("<Q", 1 << 60),
    ],
)
def test_what_is_no_message_is_refused(document):
    with pytest.raises(DataError):
        decode(document)


def sent(*args):
    """What the judge keeps of a call, and what the submission gets."""
    outgoing = Outgoing(args, {})
    return outgoing, Incoming(crossed(outgoing.message), lambda n, a: outgoing.call(n, a))


def test_arguments_arrive_and_their_changes_come_back():
    x = torch.zeros(2)
    rows = [1, 2]
    generator = torch.Generator().manual_seed(3)
    outgoing, incoming = sent(x, rows, generator, lambda y: y + 1, CAMERA)
    got, numbers, random, function, camera = incoming.args
    assert camera == CAMERA
    assert function(41) == 42  # computed by the judge
    assert incoming.changes() == {"parts": {}, "arguments": {}}
    got += 5
    numbers.append(3)
    drawn = torch.rand(3, generator=random)
    outgoing.take_back(crossed(incoming.changes()))
    assert x.tolist() == [5, 5]
    assert rows == [1, 2, 3]
    expected = torch.Generator().manual_seed(3)
    assert torch.equal(drawn, torch.rand(3, generator=expected))
    assert torch.equal(generator.get_state(), expected.get_state())


def test_a_part_of_an_argument_cannot_be_changed():
    ctx = wall_context()
    outgoing, incoming = sent(ctx)
    incoming.args[0].frame.depth_m.zero_()  # then no seed would be the right answer
    with pytest.raises(DataError, match="work on a copy"):
        outgoing.take_back(crossed(incoming.changes()))
    assert ctx.frame.depth_m.min() == 2


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"parts": {9: torch.zeros(2)}, "arguments": {}},
        {"parts": {0: torch.zeros(3)}, "arguments": {}},
        {"parts": {0: "no tensor"}, "arguments": {}},
        {"parts": {}, "arguments": {0: [1]}},
        {"parts": [], "arguments": []},
    ],
)
def test_a_change_that_is_not_possible_is_refused(changes):
    outgoing, _ = sent(torch.zeros(2))
    with pytest.raises(DataError):
        outgoing.take_back(changes)


def test_long_words_are_cut():
    assert len(cut("x" * 1_000_000)) < 2100
    assert "1,000,000 characters" in cut("x" * 1_000_000)
