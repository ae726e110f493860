"""Dealing the tasks of a parallel loop out evenly.

``prange`` gives each thread one run of consecutive numbers. Work is not even along them: what the camera sees lies
together in a map whose rows are ordered by birth, and in an image some tiles have all the splats. So task numbers are
dealt out like cards, to ``HANDS`` hands, and a thread gets whole hands::

    for k in prange(deal_size(n)):
        task = dealt(k, n)
        if task >= n:
            continue
"""

from numba import njit

HANDS = 16


@njit(inline="always")
def deal_size(n):
    """Numbers to run through for ``n`` tasks."""
    return (n + HANDS - 1) // HANDS * HANDS


@njit(inline="always")
def dealt(k, n):
    """The task that number ``k`` stands for; those from ``n`` on are none."""
    rounds = (n + HANDS - 1) // HANDS
    return k % rounds * HANDS + k // rounds
