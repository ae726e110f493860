"""EGG-Fusion's filtered surfels (arXiv 2512.01296) as a mapping system of gsfusion_nb. The README
says what is as published, and what could not be verified."""

from .config import EggConfig as EggConfig
from .config import egg_fusion as egg_fusion
from .insertion import egg_insertion as egg_insertion
from .mapper import EggFusion as EggFusion
from .surfel_filter import SurfelState as SurfelState
from .surfel_filter import fused as fused
from .surfel_filter import information as information
