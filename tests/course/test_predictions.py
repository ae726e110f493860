"""A prediction is recorded before the result is known, and shown beside it."""

import pytest

from gsfusion_nb.course import came, course_progress, predict, progress
from gsfusion_nb.course import predictions as module


@pytest.fixture(autouse=True)
def _own_file(tmp_path, monkeypatch):
    monkeypatch.setenv("GSNB_COURSE_FILE", str(tmp_path / "course.json"))
    monkeypatch.setattr(progress, "_messages", set())
    monkeypatch.setattr(module, "_unkept", {})


def test_a_choice_is_recorded_and_compared():
    asked = predict("seeds", "How many?", [300, 3000, 30000])
    assert repr(asked) == "Predict: How many? (300, 3,000, 30,000)\n  not predicted yet"
    assert repr(came("seeds", 2890)) == "You made no prediction. It came: 2,890."
    assert asked.answer(3000) == "You predicted 3,000."
    outcome = came("seeds", 2890)
    assert outcome.right
    assert repr(outcome) == "You predicted 3,000. It came: 2,890. Close."
    assert "#1a7f37" in outcome._repr_html_()
    assert asked.answer(300) == "It came already. You predicted 3,000."
    assert progress.read_section("predictions")["seeds"]["came"] == 2890
    assert "1 prediction made" in repr(course_progress(0))


def test_words_and_numbers():
    predict("side", "Which side?", ["left", "right"], answer="left")
    outcome = came("side", "on the right", right="right")
    assert not outcome.right
    assert repr(outcome) == "You predicted left. It came: on the right. Right was: right."
    predict("gain", "How many dB?", unit="dB", answer=0.5)
    assert (
        repr(came("gain", 2.0))
        == "You predicted 0.5 dB. It came: 2 dB. That is 1.5 dB more than your number."
    )
    predict("sign", "By how much?", answer=1)
    assert came("sign", -1.0).words == "That is another sign, or zero."


@pytest.mark.parametrize(
    ("answer", "value", "right", "words"),
    [
        (30.0, 29.5, True, "Close."),
        (28.0, 30.5, True, "That is 2.5 dB more than your number."),
        (40.0, 32.0, False, "That is 8 dB less than your number."),
        (2.0, -1.5, False, "That is 3.5 dB less than your number."),
    ],
)
def test_of_decibels_the_difference_counts(answer, value, right, words):
    """20 dB and 40 dB are a factor of 100 in the squared error, not of two."""
    predict("level", "How many dB?", unit="dB", answer=answer)
    outcome = came("level", value)
    assert (outcome.right, outcome.words) == (right, words)


def test_of_choices_in_decibels_the_nearest_is_right():
    """1.9 is nearer to 1 than to 3, though not in ratio."""
    predict("gain", "How many dB?", [0.1, 1, 3], unit="dB", answer=1)
    assert came("gain", 1.9).right


@pytest.mark.parametrize(
    ("choices", "answer"),
    [([1, 2], 3), ((), "many"), ((), float("nan"))],
)
def test_an_answer_that_was_not_asked_for_is_refused(choices, answer):
    with pytest.raises(ValueError, match="prediction x: expected"):
        predict("x", "?", choices, answer=answer)


def test_the_widget_records_and_a_stored_notebook_has_none(monkeypatch):
    asked = predict("gain", "Is 1 < 2?", ["yes", "<b>no</b>"])
    question, buttons, said = asked._widget.children
    assert "1 &lt; 2" in question.value
    buttons.value = "yes"
    assert said.value == "You predicted yes."
    assert asked._widget.children[1].value == "yes"
    number = predict("number", "How many?", unit="dB")._widget.children
    number[1].value = "two"
    assert "Please give a number" in number[2].value
    number[1].value = "2,5"
    assert number[2].value == "You predicted 2.5 dB."
    monkeypatch.setenv("GSNB_VIEW", "static")
    bundle = asked._repr_mimebundle_()[0]
    assert set(bundle) == {"text/plain", "text/html"}
    assert "&lt;b&gt;no" in bundle["text/html"]


def test_a_damaged_file_does_not_stop_the_notebook(tmp_path, capsys):
    (tmp_path / "course.json").write_text("{")
    predict("side", "Which side?", ["left", "right"], answer="left")
    assert came("side", "left", right="left").right
    assert capsys.readouterr().out.count("Your progress is not kept") == 1
    assert "Your progress is not known" in repr(course_progress(0))
