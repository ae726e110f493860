"""Exercises of the course: checkers by chapter, predictions, progress, and the copies of the
notebooks."""

from . import learner_backend as mine
from .course import course_progress as course_progress
from .exercise import check as check
from .exercise import exercises as exercises
from .predictions import came as came
from .predictions import predict as predict

__all__ = ["came", "check", "course_progress", "exercises", "mine", "predict"]
