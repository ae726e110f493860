"""The pages of the quiz with answers that react: the questions and the page of answers, joined."""

import re

from .pages import raw

_ANSWER = re.compile(r"^\| `([\w-]+)` \| ([A-D]) \| (.+) \|$", re.MULTILINE)
_QUESTION = re.compile(r"^\*\*([\w-]+)\*\*\n(.*?)((?:^- [A-D]\. [^\n]*\n?)+)", re.MULTILINE | re.DOTALL)
_OPTION = re.compile(r"^- ([A-D])\. (.*)$", re.MULTILINE)


def with_answers(questions: str, answers: str) -> str:
    """A page of questions whose options can be chosen; the checker's sentence comes after the choice.

    Args:
        questions: ``chapter_NN.md``.
        answers: ``answers.md``.

    Raises:
        ValueError: a question has no answer.
    """
    from markdown_it import MarkdownIt

    inline = MarkdownIt().renderInline
    known = {name: (letter, said) for name, letter, said in _ANSWER.findall(answers)}

    def form(match: re.Match[str]) -> str:
        name, asked, options = match.groups()
        if name not in known:
            raise ValueError(f"answers.md has no answer to {name}; run: make quiz")
        letter, said = known[name]
        rows = "".join(
            f'<label><input type="radio" name="{name}" value="{key}"><span>{key}. {inline(text)}</span></label>'
            for key, text in _OPTION.findall(options)
        )
        said = inline(said.replace(r"\|", "|"))
        return f"### {name}\n{asked}\n" + raw(
            f'<form class="gsnb-quiz" data-right="{letter}"><fieldset><legend>Your answer to {name}</legend>{rows}'
            f'</fieldset><p role="status"></p><p class="gsnb-said" hidden>The checker says: {said}</p></form>'
        )

    return _QUESTION.sub(form, questions)
