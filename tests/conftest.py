"""What all tests share: markers, and property tests that draw the same examples every time."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, settings

pytest.register_assert_rewrite("tests")  # so that helpers, too, say what they compared

settings.register_profile(
    "house",
    derandomize=True,
    deadline=None,
    database=None,
    max_examples=40,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("house")


def pytest_configure(config) -> None:  # type: ignore[no-untyped-def]
    config.addinivalue_line("markers", "slow: takes more than a few seconds; left out of `make fast`")
