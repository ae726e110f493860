"""``gsfusion-nb bench``: time and memory of the operations on this machine."""

from .options import BenchOptions as BenchOptions
from .run import main as main
from .scene import random_scene as random_scene
