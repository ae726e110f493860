"""``gsfusion-nb bench``: what the operations cost on this machine, beside other programs, in one table."""

from .options import BenchOptions as BenchOptions
from .rows import Row as Row
from .run import BenchResult as BenchResult
from .run import main as main
from .run import run_bench as run_bench
from .scene import Scene as Scene
from .scene import random_scene as random_scene
