"""|S| at the running speed, for `check` and `sensitivity`: a peak near this speed is excited once per revolution."""

from typing import Any

import numpy as np

from ambjax.linear.margins import NO_PEAK, ResponsePeak
from ambjax.linear.state_space import StateSpace
from ambjax.world.rotation import PER_MINUTE, Rotation

# A peak of |S| is near the running speed if it is within this share of it.
NEAR = 0.1


def running_speeds(rotor: Rotation | None, duration: float) -> tuple[float, ...]:
    """Return the speeds (Hz) at the start, the corners and the end of a run, without 0, each once."""
    if rotor is None:
        return ()
    speeds = {abs(PER_MINUTE * float(rotor.rpm(t))) for t in rotor.corners(duration)}
    return tuple(sorted(speeds - {0.0}))


def running_facts(
    speeds: tuple[float, ...], system: StateSpace, peak: ResponsePeak, axis: int = 0, what: str = "|S|"
) -> tuple[list[dict[str, Any]], list[str]]:
    """Return |S| at each speed (Hz) for the JSON summary, and as lines of text; neither for an unstable loop."""
    if not speeds or peak == NO_PEAK:
        return [], []
    found = np.abs(np.asarray(system.response(np.array(speeds)))[:, axis, axis]).tolist()
    low, high = (1 - NEAR) * speeds[0], (1 + NEAR) * speeds[-1]
    facts = [{"frequency_hz": speed, "S": S} for speed, S in zip(speeds, found, strict=True)]
    at = ", ".join(f"{S:.4g} at {speed:.4g} Hz" for speed, S in zip(speeds, found, strict=True))
    lines = [f"Once per revolution: {what} is {at}."]
    if low <= peak.frequency <= high:
        lines.append(
            f"WARNING: the peak of {what}, {peak.height:.4g} at {peak.frequency:.4g} Hz, is within {100 * NEAR:g} % of "
            "the running speed: unbalance and runout excite it. Move the peak or the speed."
        )
    return facts, lines
