"""What a person may set about the book: ``docs/book/book.toml``."""

import dataclasses
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

_GITHUB = re.compile(r"https://github\.com/([\w.-]+/[\w.-]+)")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of the book."""

    title: str = "gsfusion_nb"
    repository: str = ""
    """Address of the project's repository without a slash at its end; "" leaves all links to it out."""
    branch: str = "main"
    """Branch that the links lead to."""

    def __post_init__(self) -> None:
        if self.repository and not re.fullmatch(r"https?://[^\s]+[^\s/]", self.repository):
            raise ValueError(
                f"repository must be an address such as https://github.com/OWNER/NAME, got {self.repository!r}"
            )

    @property
    def files(self) -> str:
        """Address below which the repository shows its files, with a slash at its end; "" without a repository."""
        return f"{self.repository}/blob/{self.branch}/" if self.repository else ""

    def launches(self, notebook: str) -> dict[str, str]:
        """Name of a service that runs a notebook -> address. Only for a repository on GitHub, which both can read."""
        match = _GITHUB.fullmatch(self.repository)
        if match is None:
            return {}
        return {
            "Binder": f"https://mybinder.org/v2/gh/{match[1]}/{self.branch}?labpath={quote(notebook, safe='')}",
            "Colab": f"https://colab.research.google.com/github/{match[1]}/blob/{self.branch}/{quote(notebook)}",
        }


def read_settings(path: Path, repository: str = "") -> Settings:
    """Settings from a file.

    Args:
        path: The file.
        repository: Takes the place of the file's address, if given.

    Raises:
        ValueError: a setting that does not exist, or a wrong value.
    """
    given = tomllib.loads(path.read_text(encoding="utf-8"))
    known = [field.name for field in dataclasses.fields(Settings)]
    for name, value in given.items():
        if name not in known or not isinstance(value, str):
            raise ValueError(f"{path}: {name} = {value!r}; expected a text for one of {', '.join(known)}")
    return Settings(**{**given, **({"repository": repository} if repository else {})})
