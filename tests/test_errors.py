"""Messages: one line, and never longer than a reader's patience."""

from gsfusion_nb.checks import shown
from gsfusion_nb.files import BadFrameError, SequenceError, SequenceNotFoundError
from gsfusion_nb.recordings.fetch import ArchiveError


def test_values_of_others_are_shown_short():
    assert shown("rgb/0.png") == "'rgb/0.png'"
    assert shown(None) == "None"
    assert shown([1, 2.5, "x"]) == "[1, 2.5, 'x']"
    for value in (
        "a" * 10**6,
        b"a" * 10**6,
        list(range(10**6)),
        {"a": "b" * 1000},
        10**200,
        "\n" * 500,
    ):
        text = shown(value)
        assert len(text) <= 120
        assert "\n" not in text
        assert text.endswith("...")


def test_sentences_have_one_line_and_a_limit():
    for kind in (SequenceError, SequenceNotFoundError, BadFrameError, ArchiveError):
        assert str(kind("a.txt is empty")) == "a.txt is empty"
        text = str(kind(f"scan/{'a' * 5000}\n{'b' * 5000}.png does not exist; expected an image"))
        assert len(text) <= 1000
        assert "\n" not in text
        assert text.startswith("scan/aaa")
        assert text.endswith("bb.png does not exist; expected an image")
