"""Events of a tuning, for whoever listens: a terminal, a notebook or a file. No other module of the tuner prints them.

An event is a sentence, or the standing of a search after an iteration. `Log`, the default listener, writes lines to
stderr.
"""

import math
import time
from collections.abc import Callable
from typing import NamedTuple

from ambjax.host.heartbeat import SILENCE, Heartbeat
from ambjax.text.words import duration


class Reached(NamedTuple):
    """A limit of [tune.limits]: the search's value and the limit itself, in the unit of the quantity.

    `value` is a bound of the worst member's value, as the search computes it; `other` is the bound on the other side.
    `holds`: whether `value` is within the limit.
    """

    name: str
    value: float
    threshold: float
    holds: bool
    other: float

    @property
    def text(self) -> str:
        """The limit as a phrase."""
        low, high = sorted((self.value, self.other))
        if not self.holds and low <= self.threshold <= high:
            return f"{self.name} from {low:.3g} to {high:.3g} (limit {self.threshold:g})"
        return f"{self.name} {self.value:.3g} ({'within' if self.holds else 'beyond'} {self.threshold:g})"


class Standing(NamedTuple):
    """The best point of a search, on the members that the search simulates.

    `number`: of the search, from 1. `iteration`, `most`: number of its iterations, and their largest number.
    `starts`: number of starts that continue. `error_m`, `u_V`: settled rms error (m) and rms voltage (V). `held`,
    `members`: number of members that are held, and of all. `limits`: the limits. `left_s`: largest time left in this
    search, s; NaN if it is not known yet, or if the search has converged. `goal`: the minimised number. `rollouts`:
    number of rollouts of all searches so far.
    """

    number: int
    iteration: int
    most: int
    starts: int
    error_m: float
    u_V: float
    held: int
    members: int
    limits: tuple[Reached, ...]
    left_s: float
    goal: float = math.nan
    rollouts: int = 0

    @property
    def text(self) -> str:
        """The standing in one line."""
        beyond = [one.text for one in self.limits if not one.holds]
        met = ", ".join(beyond) if beyond else "limits met" if self.limits else ""
        left = "" if math.isnan(self.left_s) else f"at most {duration(self.left_s)} left in this search"
        starts = {0: "converged", 1: "1 start"}.get(self.starts, f"{self.starts} starts")
        parts = [
            f"search {self.number}: iteration {self.iteration} of at most {self.most}, {starts}",
            f"best so far {self.error_m:.3g} m rms at {self.u_V:.3g} V rms",
            f"{self.held} of {self.members} members held",
            met,
            left,
        ]
        return "; ".join(part for part in parts if part)


class Event(NamedTuple):
    """An event. `text`: the event in one line. `standing`: of the search after an iteration; None for other events."""

    text: str
    standing: Standing | None = None


# What receives events, and what sends an event that is a sentence.
Listener = Callable[[Event], None]
Tell = Callable[[str], None]


def teller(listen: Listener) -> Tell:
    """Return the function that sends a sentence to the listener."""
    return lambda text: listen(Event(text))


class Log(Heartbeat):
    """Listener that writes lines to stderr, each with the time since its beginning.

    It writes the standing of a search at most once in half of SILENCE. As a context manager, it also repeats its last
    line after SILENCE, so that a user sees what takes so long. On a terminal, such repetitions and standings overwrite
    each other.
    """

    def __call__(self, event: Event) -> None:
        with self.lock:
            self.text = event.text
            if event.standing is None:
                self.line(event.text)
            elif time.monotonic() - self.written >= SILENCE / 2:
                self.line(event.text, passing=True)
