"""A loss and an optimiser of the user's own in a comparison, each named as FILE.py:name."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..code_keys import code_key
from ..errors import ArgumentError
from ..mapping.training import Training
from ..seeding.code_files import code_folder, module_of_source, read_code_file

TrainingCode = Mapping[str, Mapping[str, str]]
"""Loss and optimiser of a run, if they are not the system's own: "loss" or "optimiser" -> "name"
(FILE.py:name), "source" of the file, and "folder" of the modules beside it."""

_IN_WORDS = {"loss": "a loss", "optimiser": "an optimiser"}


def training_code(**names: str) -> dict[str, dict[str, str]]:
    """What a run stores of a loss and an optimiser, given as "FILE.py:name"; one that is empty is
    the system's own.

    Raises:
        ValueError: not FILE.py:name, or what the file has is no loss or optimiser.
        TypeError: it is no function. FileNotFoundError: no such file.
    """
    code = {
        kind: {
            "name": text,
            "source": read_code_file(text, _IN_WORDS[kind])[0],
            "folder": str(code_folder(text)),
        }
        for kind, text in names.items()
        if text
    }
    Training(**training_functions(code))
    return code


def training_functions(code: TrainingCode) -> dict[str, Callable[..., Any]]:
    """The loss and the optimiser, as arguments of ``make_mapper``.

    Raises:
        ValueError: a file cannot be loaded, or has nothing of this name.
    """
    functions = {}
    for kind, parts in code.items():
        file, _, name = parts["name"].rpartition(":")
        folder = Path(parts["folder"])
        module = module_of_source(parts["source"], str(folder / Path(file).name), folder)
        function = vars(module).get(name)
        if not callable(function):
            raise ArgumentError(f"{file} has no function {name!r}; expected {_IN_WORDS[kind]}")
        functions[kind] = function
    return functions


def training_key(code: TrainingCode) -> tuple[dict[str, str], str]:
    """What a loss and an optimiser are made of, as parts of the key of a run; and why no later
    command can use a result with them, or empty."""
    parts: dict[str, str] = {}
    reason = ""
    for kind, function in training_functions(code).items():
        key = code_key(function)
        parts[kind] = code[kind]["name"].rpartition(":")[2]
        parts |= {
            f"{kind}: {name.replace('of the rule', f'of the {kind}')}": digest
            for name, digest in key.parts.items()
        }
        reason = reason or key.reason
    return parts, reason
