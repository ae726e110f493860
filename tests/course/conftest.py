"""For the tests of the course: no learner's function is kept from another test."""

import pytest

from gsfusion_nb import backends
from gsfusion_nb.course import mine


@pytest.fixture
def nothing_kept(monkeypatch):
    """No function is kept, and the counts of the board are zero."""
    for kept in (backends.FUNCTIONS, mine.KEPT):
        for name in list(kept):
            monkeypatch.delitem(kept, name)
    mine.clear_counts()
    yield
    mine.forget()
    mine.clear_counts()
