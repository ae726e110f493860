"""``python -m gsfusion_nb`` is ``gsfusion-nb``."""

import sys

from .cli import program

if __name__ == "__main__":
    sys.exit(program())
