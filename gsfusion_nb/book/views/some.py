"""A few of many, evenly spread."""

from collections.abc import Sequence
from typing import Any

import numpy as np


def some(entries: Sequence[Any], most: int) -> list[Any]:
    """At most so many entries, the first and the last among them."""
    every = np.linspace(0, len(entries) - 1, min(len(entries), most)).round().astype(int)
    return [entries[k] for k in every]
