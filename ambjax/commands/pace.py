"""Expected duration of an ensemble, its chunk size, and the error of the sliding step."""

import dataclasses
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ambjax.ensemble.batching import cores
from ambjax.ensemble.study import AnyStudy, Study
from ambjax.ensemble.worker import CALL, chunk
from ambjax.host.heartbeat import say
from ambjax.simulation.method import TOLERANCE
from ambjax.simulation.rosenbrock import AdaptiveRodas3
from ambjax.simulation.sliding import slides

# Target duration of a chunk, s. It is the largest time lost by an interruption, and the interval of the progress bar.
CHUNK_SECONDS = 2.0
# Largest number of members per chunk.
MOST_CHUNK = 65_536
# Members per chunk, and members that `pilot` times, on an accelerator.
ACCELERATOR_CHUNK = 1024
# The expected duration is printed above SHORT, and a faster method suggested above LONG, both in s.
SHORT, LONG = 3.0, 60.0
# Number of members, and metrics, in the comparison of the sliding step with adaptive steps.
COMPARISON, COMPARED = 16, ("settled_rms_error_m", "rms_u_V", "chatter_V")


class Pace(NamedTuple):
    """Members per second of this process on all its cores, and the number of worker processes (None: no workers)."""

    rate: float
    workers: int | None

    @property
    def whole(self) -> float:
        """Members per second of the whole study, if each worker is as fast as one core of this machine."""
        return self.rate if self.workers is None else self.rate / cores() * self.workers

    def chunk(self, members: int) -> int:
        """Return the members per chunk: about CHUNK_SECONDS of work, at most half of a worker's members.

        The number is rounded up to a multiple of CALL per core, and is at most `members`.
        """
        if jax.default_backend() != "cpu":
            return min(ACCELERATOR_CHUNK, members)
        unit, rate = (CALL * cores(), self.rate) if self.workers is None else (CALL, self.rate / cores())
        fair = members if self.workers is None else -(-members // (2 * self.workers))
        count = min(round(CHUNK_SECONDS * rate), fair, MOST_CHUNK)
        return min(max(-(-count // unit), 1) * unit, members)


def pilot(study: AnyStudy) -> tuple[dict[str, np.ndarray], float]:
    """Simulate the first members: one call of CALL members on each core. Return their columns and the duration in s."""
    first = min(CALL * cores() if jax.default_backend() == "cpu" else ACCELERATOR_CHUNK, study.members)
    chunk(study, 0, first, first, lost=True)
    if first < study.members:
        say(f"timing the first {first} members ...")
    began = time.perf_counter()
    columns = chunk(study, 0, first, first)
    return {name: np.asarray(x) for name, x in columns.items()}, time.perf_counter() - began


def print_estimate(study: AnyStudy, pace: Pace) -> None:
    """Print a duration of at least SHORT. Above LONG, suggest the sliding step if it applies."""
    seconds = study.members / pace.whole
    if seconds < SHORT:
        return
    rate = f"{pace.whole:.2g}" if pace.whole < 10 else f"{pace.whole:,.0f}"
    words = f"about {duration(seconds)} for {study.members:,} members ({rate} a second)"
    adaptive = isinstance(study.clock.method, AdaptiveRodas3)
    if seconds > LONG and adaptive and isinstance(study, Study) and slides(study.cascade, study.scenario):
        words += '; clock.method = "sliding" would be faster; its error is measured and printed'
    say(words)


def duration(seconds: float) -> str:
    """Return a duration as text, in s, min or h."""
    for size, unit in ((3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.2g} {unit}" if seconds < 10 * size else f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


def sliding_error(study: Study) -> dict[str, Any]:
    """Compute the largest relative difference of each metric in COMPARED between this study's steps and adaptive steps.

    The comparison uses the first COMPARISON members, without those that are lost or stalled with either kind of steps.
    """
    tolerance = max(TOLERANCE, 1e3 * float(jnp.finfo(jnp.result_type(float)).eps))
    accurate = dataclasses.replace(study, clock=study.clock.with_method(AdaptiveRodas3(tolerance)))
    count = min(COMPARISON, study.members)
    ours, theirs = (chunk(one, 0, count, count) for one in (study, accurate))
    ends = [~np.isfinite(columns["lost_at"]) for columns in (ours, theirs)]
    both = ends[0] & ends[1]
    error: dict[str, Any] = {"members": count, "lost_by_one": int((ends[0] != ends[1]).sum())}
    for name in COMPARED:
        a, b = (np.asarray(columns[name])[both] for columns in (ours, theirs))
        size = np.maximum(np.abs(b), np.finfo(float).tiny)  # avoids 0 / 0
        error[name] = float(np.max(np.abs(a - b) / size)) if both.any() else None
    return error


def error_words(error: dict[str, Any]) -> str:
    """Return the error of the sliding step as text."""
    words = f"sliding step against adaptive steps, {error['members']} members: "
    if error[COMPARED[0]] is None:
        words += "no member survives with both"
    else:
        words += ", ".join(f"{name} off by {100 * error[name]:.2g} %" for name in COMPARED) + " at most"
    return f"{words}; {error['lost_by_one']} survive with only one"
