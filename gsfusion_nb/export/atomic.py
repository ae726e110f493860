"""Writing a file so that it is either whole or not there."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path to write to, which takes the place of ``path`` when the block ends without an exception.

    The temporary file lies in the same folder (created if need be) and has the same suffix. After an exception, Ctrl-C
    included, it is removed, and a previous file at ``path`` is as it was.

        with atomic_path("run/metrics.json") as temporary:
            temporary.write_text(text)

    Raises:
        FileNotFoundError: the block wrote nothing to the temporary path.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.partial{path.suffix}")
    try:
        yield temporary
        if not temporary.exists():
            raise FileNotFoundError(
                f"nothing was written for {path}; expected the block to write to the path it was given"
            )
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
