"""The checkpoint of a search for the gains of a machine: what it has found after each start."""

import pathlib
from typing import Any, NamedTuple

import numpy as np

from ambjax.host.sealed import DamagedError, difference, seal, unseal
from tuning.events import Tell
from tuning.machines.nonsmooth import Value


class Progress(NamedTuple):
    """A search after `number` starts.

    `best`: lowest peak, with the `fewest` members that are lost or beyond a limit. `slowest`: least growth rate of a
    pole. `seconds`: duration so far, s.
    """

    number: int
    best: Value
    fewest: float
    slowest: Value
    seconds: float

    @property
    def answer(self) -> Value:
        """The best point; that of the least growth rate if no start could be made stable."""
        return self.best if np.isfinite(self.best.f) else self.slowest


def save(path: pathlib.Path, facts: dict[str, Any], now: Progress) -> None:
    """Write the checkpoint. `facts`: what a resumed search must match. Raises ValueError if it cannot be written."""
    numbers = np.array([now.number, now.best.f, now.fewest, now.slowest.f, now.seconds])
    arrays = {"best": now.best.x, "slowest": now.slowest.x, "numbers": numbers}
    seal(path, arrays, {"fingerprint": facts})


def saved(path: pathlib.Path, facts: dict[str, Any], tell: Tell) -> Progress | None:
    """Return the checkpoint; None if there is none, or if it is damaged, which `tell` receives.

    Raises ValueError if it belongs to another search.
    """
    if not path.exists():
        return None
    try:
        arrays, found = unseal(path)
    except DamagedError as why:
        tell(f"{path}: {why}; the search begins again")
        return None
    if differs := difference(found["fingerprint"], facts):
        raise ValueError(
            f"--resume: {path} belongs to another search: {differs}. "
            "Use another --out, or leave out --resume to start a new search."
        )
    number, best, fewest, slowest, seconds = arrays["numbers"].tolist()
    none = np.zeros(len(arrays["best"]))
    return Progress(
        int(number), Value(arrays["best"], best, none), fewest, Value(arrays["slowest"], slowest, none), seconds
    )
