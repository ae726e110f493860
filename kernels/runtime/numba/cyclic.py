"""Cyclic distribution of a parallel loop's tasks over threads.

``prange`` gives each thread one run of consecutive numbers. The work is not even along them: what the camera sees is
stored together in a map whose rows are in the order of their creation, and in an image some tiles have all the splats.
The numbers of the loop are therefore mapped to tasks round robin, in ``GROUPS`` groups, and a thread gets whole
groups::

    for k in prange(cyclic_size(n)):
        task = cyclic_task(k, n)
        if task >= n:
            continue
"""

from numba import njit

GROUPS = 16


@njit(inline="always")
def cyclic_size(n):
    """Numbers that the loop runs through for ``n`` tasks: ``n`` rounded up to whole rounds."""
    return (n + GROUPS - 1) // GROUPS * GROUPS


@njit(inline="always")
def cyclic_task(k, n):
    """The task of number ``k`` of the loop; numbers from ``n`` on stand for no task."""
    rounds = (n + GROUPS - 1) // GROUPS
    return k % rounds * GROUPS + k // rounds
