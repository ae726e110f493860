"""Finds links of a built site that lead nowhere, and everything that a page would load from another server."""

import re
import urllib.parse
from html.parser import HTMLParser
from pathlib import Path

_ELSEWHERE = re.compile(r"^(?:[a-z][a-z0-9+.-]*:|//)", re.IGNORECASE)
_LOADING = {("script", "src"), ("img", "src"), ("link", "href"), ("iframe", "src"), ("source", "src"), ("video", "src")}
_CSS_URL = re.compile(r"""url\(\s*["']?((?:https?:)?//[^"')\s]+)|@import\s+["']((?:https?:)?//[^"']+)""")


class _Page(HTMLParser):
    """Targets and places of one page."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.places: set[str] = set()
        self.targets: list[str] = []
        self.loaded: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "link" and not {"stylesheet", "icon", "preload", "script"} & set(
            (dict(attrs).get("rel") or "").split()
        ):
            return
        for name, value in attrs:
            if not value:
                continue
            if name == "id" or (name == "name" and tag == "a"):
                self.places.add(value)
            elif name in ("href", "src") or (name == "data-src" and not value.startswith("data:")):
                elsewhere = bool(_ELSEWHERE.match(value))
                if not elsewhere:
                    self.targets.append(value)
                elif (tag, name) in _LOADING and not value.startswith("data:"):
                    self.loaded.append(value)


def read_page(path: Path) -> _Page:
    """Targets and places of a page."""
    page = _Page()
    page.feed(path.read_text(encoding="utf-8"))
    return page


def broken_links(site: Path) -> list[str]:
    """A sentence for each target inside the site that does not exist, and for each file that comes from elsewhere."""
    site = site.resolve()
    pages = {path: read_page(path) for path in sorted(site.rglob("*.html"))}
    wrong = []
    for path, page in pages.items():
        name = path.relative_to(site).as_posix()
        wrong += [f"{name} loads {address} from another server" for address in page.loaded]
        for target in sorted(set(page.targets)):
            address, _, place = target.partition("#")
            file = (path.parent / urllib.parse.unquote(address.partition("?")[0])).resolve() if address else path
            file = file / "index.html" if file.is_dir() else file
            if not file.is_file():
                wrong.append(f"{name} leads to {target}: no such file")
            elif site not in file.parents:
                wrong.append(f"{name} leads to {target}, outside the site")
            elif place and file in pages and urllib.parse.unquote(place) not in pages[file].places:
                wrong.append(f"{name} leads to {target}: the page has no such place")
    for sheet in sorted(site.rglob("*.css")):
        for found in _CSS_URL.findall(sheet.read_text(encoding="utf-8")):
            wrong.append(f"{sheet.relative_to(site).as_posix()} loads {''.join(found)} from another server")
    return wrong
