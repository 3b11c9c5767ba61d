"""How much the tests try: `AMBJAX_TESTS=thorough` runs every combination and thousands of random examples.

By default the slow tests cover each law and each structure at least once, with few random examples.
"""

import os

import pytest

PROFILES = ("usual", "thorough")
PROFILE = os.environ.get("AMBJAX_TESTS", "usual")
if PROFILE not in PROFILES:
    raise ValueError(f"AMBJAX_TESTS = {PROFILE!r}: it must be one of {', '.join(PROFILES)}.")
THOROUGH = PROFILE == "thorough"


def examples(usual: int, thorough: int) -> int:
    """Return the number of examples of this profile."""
    return thorough if THOROUGH else usual


def thorough(*values: object, id: str | None = None):
    """Return values of parameters for the thorough profile only: other values test the same."""
    return pytest.param(*values, id=id, marks=pytest.mark.thorough)
