"""Units of exported numbers as products of powers of the base units of SI, for FMI."""

import re
from collections import Counter

# Exponents of the base units in each derived unit.
DERIVED = {
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "ohm": {"kg": 1, "m": 2, "s": -3, "A": -2},
    "N": {"kg": 1, "m": 1, "s": -2},
    "Hz": {"s": -1},
    "W": {"kg": 1, "m": 2, "s": -3},
    "rad": {"rad": 1},
}
BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
# Units without a dimension.
COUNTS = ("", "1", "samples", "turns")


def exponents(unit: str) -> dict[str, int] | None:
    """Return the exponents of the base units in a unit, or None for an unknown unit.

    Example: {"m": -2, "A": 2} for "A^2/m^2". A factor after a "/" is in the denominator.
    """
    total: Counter[str] = Counter()
    for k, part in enumerate(unit.split("/")):
        for factor in part.split():
            found = re.fullmatch(r"([A-Za-z]+|1)(?:\^(-?\d+))?", factor)
            if found is None:
                return None
            name, power = found[1], int(found[2] or 1) * (-1 if k else 1)
            if name in COUNTS:
                continue
            if name not in DERIVED and name not in BASE:
                return None
            for base, exponent in DERIVED.get(name, {name: 1}).items():
                total[base] += power * exponent
    return {base: total[base] for base in BASE if total[base]}
