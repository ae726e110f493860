"""Live view of a contest of seeding rules: a Pareto plot that is updated while the rules run, with start, pause and
stop."""

from ..drawing.curves import figure_picture
from ..drawing.pictures import Picture
from ..viz.live.live_loop import LiveLoop
from .contest import Contest
from .leaderboard import Leaderboard


def watch_contest(contest: Contest) -> LiveLoop:
    """Show the contest with buttons; ``contest.board`` is the table, during the run and after it.

    One step is one frame. Stopping discards only the frames of the rule that was running.
    """
    drawn: list[tuple[int, Picture]] = []

    def picture() -> Picture:
        if not drawn or drawn[-1][0] != len(contest.board):
            drawn[:] = [(len(contest.board), board_picture(contest.board))]
        return drawn[-1][1]

    return LiveLoop(contest.steps, picture, contest.curves, n_steps=contest.n_frames, width=640)


def board_picture(board: Leaderboard) -> Picture:
    """The Pareto plot as an image."""
    return figure_picture(board.figure())
