"""How long an ensemble takes, how it is cut into chunks for that, and what the sliding step is worth on it."""

import dataclasses
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ambjax.commands.outputs import say
from ambjax.ensemble.batching import cores
from ambjax.ensemble.study import Study
from ambjax.ensemble.worker import CALL, chunk
from ambjax.simulation.integrate import AdaptiveRodas3
from ambjax.simulation.method import TOLERANCE
from ambjax.simulation.sliding import slides

# What a chunk takes, in s: so much is lost at most, and so long does the progress bar stand still.
BEAT = 2.0
MOST_CHUNK = 65_536
# Members of the pilot on an accelerator, whose calls are whole chunks.
BESIDE_CPU = 1024
# A shorter run is not announced; for a longer one a faster method is named, in s.
SHORT, LONG = 3.0, 60.0
# Members on which the sliding step is compared with adaptive ones, and by what.
COMPARISON, BY = 16, ("settled_rms_error_m", "rms_u_V", "chatter_V")


class Pace(NamedTuple):
    """Members per second of this process on all its cores, and the worker processes that run instead (None: none)."""

    rate: float
    workers: int | None

    @property
    def whole(self) -> float:
        """Members per second of the whole study, s^-1; workers elsewhere taken to be as fast as a core here."""
        return self.rate if self.workers is None else self.rate / cores() * self.workers

    def chunk(self, members: int) -> int:
        """Members in a chunk: whole calls of what runs it, for about BEAT seconds, and enough chunks for all."""
        if jax.default_backend() != "cpu":
            return min(BESIDE_CPU, members)
        unit, rate = (CALL * cores(), self.rate) if self.workers is None else (CALL, self.rate / cores())
        fair = members if self.workers is None else -(-members // (2 * self.workers))
        count = min(round(BEAT * rate), fair, MOST_CHUNK)
        return min(max(-(-count // unit), 1) * unit, members)


def pilot(study: Study) -> tuple[dict[str, np.ndarray], float]:
    """The rows of the first members, as many as run here at once, and the seconds that they took.

    The program is compiled before, by rotors that are lost when they start: they cost next to nothing. Then a line says
    what is waited for, where there is more to come: of slow members a call takes a minute.
    """
    first = min(CALL * cores() if jax.default_backend() == "cpu" else BESIDE_CPU, study.members)
    chunk(study, 0, first, first, lost=True)
    if first < study.members:
        say(f"timing the first {first} members ...")
    began = time.perf_counter()
    columns = chunk(study, 0, first, first)
    return {name: np.asarray(x) for name, x in columns.items()}, time.perf_counter() - began


def say_how_long(study: Study, pace: Pace) -> None:
    """Announce a run that takes more than a moment, and name the faster step where there is one."""
    seconds = study.members / pace.whole
    if seconds < SHORT:
        return
    rate = f"{pace.whole:.2g}" if pace.whole < 10 else f"{pace.whole:,.0f}"
    words = f"about {duration(seconds)} for {study.members:,} members ({rate} a second)"
    if (
        seconds > LONG
        and isinstance(study.clock.method, AdaptiveRodas3)
        and slides(study.cascade, study.scenario.plant)
    ):
        words += '; clock.method = "sliding" would be faster: its error is measured and told'
    say(words)


def duration(seconds: float) -> str:
    """A time in words, two digits."""
    for size, unit in ((3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.2g} {unit}" if seconds < 10 * size else f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def sliding_error(study: Study) -> dict[str, Any]:
    """The largest relative difference of each metric in BY between this study's steps and adaptive ones.

    Over those of its first members whom both hold (None: no such member); `lost_by_one` counts those whom one of them
    loses, or cannot decide, and not the other.
    """
    tolerance = max(TOLERANCE, 1e3 * float(jnp.finfo(jnp.result_type(float)).eps))
    accurate = dataclasses.replace(study, clock=dataclasses.replace(study.clock, method=AdaptiveRodas3(tolerance)))
    count = min(COMPARISON, study.members)
    ours, theirs = (chunk(one, 0, count, count) for one in (study, accurate))
    ends = [~np.isfinite(columns["lost_at"]) for columns in (ours, theirs)]
    both = ends[0] & ends[1]
    error: dict[str, Any] = {"members": count, "lost_by_one": int((ends[0] != ends[1]).sum())}
    for name in BY:
        a, b = (np.asarray(columns[name])[both] for columns in (ours, theirs))
        size = np.maximum(np.abs(b), np.finfo(float).tiny)  # nothing to compare with: 0 if equal, else huge
        error[name] = float(np.max(np.abs(a - b) / size)) if both.any() else None
    return error


def error_words(error: dict[str, Any]) -> str:
    """The error of the sliding step in words."""
    words = f"sliding step against adaptive steps, {error['members']} members: "
    if error[BY[0]] is None:
        words += "none is held by both"
    else:
        words += ", ".join(f"{name} off by {100 * error[name]:.2g} %" for name in BY) + " at most"
    return f"{words}; {error['lost_by_one']} held by one of them only"
