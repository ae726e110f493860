"""A contest of seeding rules to watch: the Pareto plot fills while the rules run; start, pause and stop."""

import numpy as np

from ..drawing.curves import figure_png
from ..drawing.pictures import Picture
from ..viz.live.watch import Watch
from .leaderboard import Contest, Leaderboard


def watch_contest(contest: Contest) -> Watch:
    """The contest with buttons; ``contest.board`` is the table, while it runs and afterwards.

    One step is one frame. A stop loses nothing but the frames of the rule that was running.
    """
    drawn: list[tuple[int, Picture]] = []

    def picture() -> Picture:
        if not drawn or drawn[-1][0] != len(contest.board):
            drawn[:] = [(len(contest.board), board_picture(contest.board))]
        return drawn[-1][1]

    return Watch(contest.steps, picture, contest.curves, n_steps=len(contest.sequence.mapping), width=640)


def board_picture(board: Leaderboard) -> Picture:
    """The Pareto plot as an image."""
    import cv2

    data = np.frombuffer(figure_png(board.figure()), np.uint8)
    return np.ascontiguousarray(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[..., ::-1])
