from __future__ import annotations

import pytest
from problems import PROBLEMS, Problem


@pytest.fixture(scope="module", params=PROBLEMS, ids=lambda problem: problem.name)
def problem(request: pytest.FixtureRequest) -> Problem:
    """Each of the small problems."""
    return request.param
