"""Exercises of the course: checkers by chapter, and the student copies of the notebooks."""

from .exercise import check as check
from .exercise import exercises as exercises
