"""Where gains are searched: what a law is told of its surroundings, and the usual ways to make a range of them."""

from collections.abc import Mapping
from typing import NamedTuple

from ambjax.numerics.records import Scalar
from ambjax.numerics.smooth import TWO_OVER_PI
from ambjax.world.plant import Plant


class SearchContext(NamedTuple):
    """The surroundings of a search: nominal plant, pole w of the true one (1/s), sample period (s).

    `stepped`: on a processor, by laws whose signs act on the step's end. `bounds`: what Theorem 1 requires gains to
    exceed, by symbol. `delta_1`: what Eq. (7) asks of the reference or of a
    fall, whichever is more, A^2/m^2/s, and in words.
    """

    model: Plant
    w: float
    period: float
    bounds: Mapping[str, float]
    delta_1: tuple[float, str]
    stepped: bool = False

    @property
    def pole(self) -> str:
        """What w is, in words."""
        return f"w = {self.w:.3g} 1/s: pole of the unstable plant"


class Interval(NamedTuple):
    """Where a gain is looked for first, log-uniform, and where that comes from, in words.

    `firm`: it may not end beyond, or beyond where it starts. `times`: another gain of the law; low to high is then that
    of the product of both, which is what matters.
    """

    low: float
    high: float
    source: str
    firm: bool = False
    times: str = ""


def manifold(site: SearchContext) -> Interval:
    """Decay rate on a sliding manifold, 1/s."""
    cap = max(1 / (5 * site.period), site.w / 10)
    if cap >= 10 * site.w:
        return Interval(site.w / 30, 10 * site.w, f"w/30 to 10 w, {site.pole}", True)
    words = f"w/30 to the cap 1/(5 T), T = {site.period:g} s: the sampled loop cannot slide faster; {site.pole}"
    return Interval(site.w / 30, cap, words, True)


def switch(site: SearchContext, name: str, p: Scalar, times: float, over: str) -> Interval:
    """A switching gain by the slope 2/pi gain p of its smoothed sign, at least twice the disturbance bound `over`."""
    per, below = TWO_OVER_PI * float(p), site.bounds.get(over, 0.0)
    low, high = site.w / 3 / per, times * site.w / per
    words = f"slope 2/pi {name} p from w/3 to {times:g} w, {site.pole}"
    if 2 * below > low:
        words += f"; at least twice the disturbance, {below:.3g}"
    return Interval(max(low, 2 * below), max(high, 200 * below), words)


def authority(site: SearchContext, size: Scalar, share: tuple[float, float], what: str, over: str = "") -> Interval:
    """A switching gain on a processor, where no slope limits it: these shares of `size`, which is `what` in words."""
    below = site.bounds.get(over, 0.0)
    low, high = (part * float(size) for part in share)
    words = f"{share[0]:g} to {share[1]:g} of {float(size):.3g}, {what}"
    if 2 * below > low:
        words += f"; at least twice the disturbance, {below:.3g}"
    return Interval(max(low, 2 * below), max(high, 200 * below), words)


def steepness(site: SearchContext, name: str) -> dict[str, Interval]:
    """The steepness p of a sign on a processor, by its slope with the gain of this name; else nothing is said of it."""
    if not site.stepped:
        return {}
    low, high = (slope / TWO_OVER_PI for slope in (site.w / 3, 10 / site.period))
    words = f"slope 2/pi {name} p from w/3 to 10/T, hardly less than the sign itself; {site.pole}"
    return {"p": Interval(low, high, words, times=name)}


def rate(site: SearchContext, low: float, high: float, words: str, per: Scalar = 1.0, power: int = 1) -> Interval:
    """A gain whose rate, gain times `per` (of dimension 1/s to this power), lies from `low` to `high` times w."""
    first, last = ((share * site.w) ** power / float(per) for share in (low, high))
    return Interval(first, last, f"{words}, {site.pole}")
