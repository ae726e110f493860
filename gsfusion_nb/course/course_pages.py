"""Pages of the documentation beside a copy of the notebooks, so that no link of the copy leads nowhere."""

import re
from pathlib import Path

FOLDER = "documentation"
"""Of the pages, in the folder of the notebooks."""
_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)\s]+)\)")
_TO_A_PAGE = re.compile(r"\]\(\.\./docs/")
_TO_A_SOURCE_FILE = re.compile(r'<a href=\\"(?:\.\./)+gsfusion_nb/[^>]*>(.*?)</a>')


def docs_folder() -> Path | None:
    """The folder of the documentation, in an installed package or in a clone; ``None`` if there is none."""
    package = Path(__file__).resolve().parents[1]
    found = (folder for folder in (package / "docs", package.parent / "docs") if (folder / "index.md").is_file())
    return next(found, None)


def pages(docs: Path) -> dict[str, bytes]:
    """Path in the folder of the notebooks -> content: the pages of the documentation and their pictures.

    A link to anything that is not copied becomes its text.
    """
    texts = {path.name: path.read_text(encoding="utf-8") for path in sorted(docs.glob("*.md"))}
    found = {f"{FOLDER}/{name}": _without_dead_links(text, set(texts)).encode() for name, text in texts.items()}
    pictures = (path for path in sorted((docs / "images").glob("*")) if path.is_file())
    return found | {f"{FOLDER}/images/{path.name}": path.read_bytes() for path in pictures}


def _without_dead_links(text: str, copied: set[str]) -> str:
    def kept(match: re.Match[str]) -> str:
        page = match[2].partition("#")[0]
        return match[0] if not page or page in copied or re.match(r"https?://|images/", page) else match[1]

    return _LINK.sub(kept, text)


def with_links_to_pages(notebook: str) -> str:
    """The JSON of a notebook whose links to the documentation lead to the pages beside it.

    Links of stored outputs to source files become text; when the cell runs, the output links to the installed files.
    """
    return _TO_A_SOURCE_FILE.sub(r"\1", _TO_A_PAGE.sub(f"]({FOLDER}/", notebook))
