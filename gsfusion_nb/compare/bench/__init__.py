"""``gsfusion-nb bench``: time and memory of the operations on this machine, compared with other programs."""

from .options import BenchOptions as BenchOptions
from .rows import Row as Row
from .run import BenchResult as BenchResult
from .run import main as main
from .run import run_bench as run_bench
from .scene import RandomScene as RandomScene
from .scene import random_scene as random_scene
