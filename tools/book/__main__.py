"""``PYTHONPATH=tools python -m book runs/book`` builds the web book; see docs/book.md."""

import argparse
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

from quiz import Question, bank, by_chapter

from gsfusion_nb.viewer.page_map import page_style

from .assemble import ARCHIVE, Assembly
from .live_panels import PANELS, POSTERS, common_script, panel_script
from .moving_map import moving_map
from .page_text import FILES_OF_REPOSITORY, places_of

log = logging.getLogger(__name__)

NEEDED = ("sphinx", "myst_parser", "furo", "mathjax")
_MATHJAX = ("tex-chtml-full.js", "a11y/assistive-mml.js", "output/chtml/fonts/woff-v2")


def missing() -> list[str]:
    """What the extra ``book`` brings and is not installed."""
    return [name for name in NEEDED if find_spec(name) is None]


def build(
    root: Path,
    target: Path,
    files: str,
    quiz: Mapping[int, Sequence[Question]],
    address: str = "",
) -> None:
    """Build the book.

    Args:
        root: The project.
        target: The site; replaced. Work is kept in the folder ``.OUT_work`` beside it.
        files: Address below which a repository shows its files, with a slash at its end; "" without
            a repository.
        quiz: Questions by chapter.
        address: Where the site will be, with a slash at its end; "" if that is not known. Other
            sites show a picture beside a link only with it.

    Raises:
        RuntimeError: the extra is not installed, or Sphinx failed or warned, as of a link that
            leads nowhere.
    """
    if lacking := missing():
        raise RuntimeError(
            f"the book needs {', '.join(lacking)}; install them with: pip install "
            "'gsfusion-nb[book]'"
        )
    work = target.parent / f".{target.name}_work"
    pages = work / "pages"
    extra = work / "extra"
    static = work / "static"
    Assembly(places_of(root, files), pages, extra, quiz).write()
    _write_static(static)
    folders = {"STATIC": static, "EXTRA": extra}
    _sphinx(root, pages, folders, work / "doctrees", target, address)
    shutil.make_archive(str(work / "book"), "zip", target)
    shutil.move(work / "book.zip", target / ARCHIVE)


def _write_static(folder: Path) -> None:
    """Style sheets, scripts, and MathJax with its fonts, so that no page loads anything from
    elsewhere."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for file in (Path(__file__).parent / "static").iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    with (folder / "book.css").open("a", encoding="utf-8") as style:
        style.write(page_style())
    shutil.copytree(POSTERS, folder / "posters", ignore=shutil.ignore_patterns("*.html"))
    drawn = moving_map()
    (folder / "moving_map.js").write_text(drawn.script, encoding="utf-8")
    (folder / "moving_map.webp").write_bytes(drawn.poster)
    (folder / "share.jpg").write_bytes(drawn.share)
    (folder / "live_panels.js").write_text(common_script(), encoding="utf-8")
    for name in PANELS.values():
        (folder / f"live_{name}.js").write_text(panel_script(name), encoding="utf-8")
    mathjax = Path(str(files("mathjax").joinpath("static/mathjax/es5")))
    for name in _MATHJAX:
        target = folder / "mathjax" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if (mathjax / name).is_dir() else shutil.copyfile)(mathjax / name, target)


def _sphinx(
    root: Path,
    pages: Path,
    folders: Mapping[str, Path],
    doctrees: Path,
    target: Path,
    address: str,
) -> None:
    from gsfusion_nb import __version__

    shutil.rmtree(target, ignore_errors=True)
    environment = {
        **os.environ,
        "GSNB_BOOK_PACKAGE": str(root.resolve()),
        "GSNB_BOOK_ADDRESS": address,
        **{f"GSNB_BOOK_{name}": str(folder.resolve()) for name, folder in folders.items()},
    }
    options = ["project=gsfusion_nb", f"release={__version__}", "html_title=gsfusion_nb"]
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-W",
        "--keep-going",
        "-b",
        "html",
        "-d",
        str(doctrees),
    ]
    command += ["-c", str(root / "docs/book")]
    command += [part for option in options for part in ("-D", option)]
    process = subprocess.run(
        [*command, str(pages), str(target)],
        env=environment,
        text=True,
        stderr=subprocess.PIPE,
    )
    for line in process.stderr.splitlines():
        log.warning("%s", line)
    if process.returncode:
        shutil.rmtree(doctrees, ignore_errors=True)  # the next build begins anew
        raise RuntimeError("Sphinx could not build the book; its messages are above")
    # GitHub Pages would leave out folders that begin with an underscore
    (target / ".nojekyll").touch()


_ROOT = Path(__file__).resolve().parents[2]


def main(arguments: list[str] | None = None) -> int:
    """Build the book; 1 if it could not be built."""
    parser = argparse.ArgumentParser(prog="python -m book", description="Builds the web book.")
    parser.add_argument(
        "out", type=Path, nargs="?", default=Path("runs/book"), help="folder of the site; replaced"
    )
    parser.add_argument(
        "--installed", action="store_true", help="only say whether the extra 'book' is installed"
    )
    parser.add_argument(
        "--repository", default="", help="address of the repository, for links to source files"
    )
    parser.add_argument(
        "--address", default="", help="address where the book will be, for sites that show links"
    )
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    if options.installed:
        return 1 if missing() else 0
    try:
        for name in ("repository", "address"):
            given = getattr(options, name)
            if given and not given.startswith(("http://", "https://")):
                raise ValueError(
                    f"--{name}: expected an address such as https://example.org/name, got {given!r}"
                )
        files = (
            f"{options.repository.rstrip('/')}{FILES_OF_REPOSITORY}" if options.repository else ""
        )
        address = f"{options.address.rstrip('/')}/" if options.address else ""
        build(_ROOT, options.out, files, by_chapter(bank()), address)
    except (RuntimeError, ValueError, OSError) as e:
        logging.error("%s", e)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
