"""Ranges in which the tuner searches gains: the context that a law receives, and functions that derive a range."""

from collections.abc import Mapping
from typing import NamedTuple

from ambjax.numerics.records import Scalar
from ambjax.numerics.smooth import TWO_OVER_PI
from ambjax.world.plant import Plant


class LowerBound(NamedTuple):
    """Lower bound of a gain, its symbol, and a description of its source."""

    value: float
    symbol: str
    source: str


class SearchContext(NamedTuple):
    """Context of a search for gains.

    `model`: nominal plant. `w`: pole of the true plant, 1/s. `period`: sample period, s. `bounds`: lower bounds of
    Theorem 1 on gains, by symbol (Q_z, Q_i, Delta_1). `delta_1`: the larger of the two bounds of gamma by Eq. (7),
    along the reference and for a falling rotor, A^2/m^2/s. `stepped`: whether the laws run on a processor with implicit
    signs.
    """

    model: Plant
    w: float
    period: float
    bounds: Mapping[str, float]
    delta_1: LowerBound
    stepped: bool = False

    @property
    def pole(self) -> str:
        """Description of w."""
        return f"w = {self.w:.3g} 1/s: pole of the unstable plant"


class Interval(NamedTuple):
    """Log-uniform range of initial values of a gain, and a description of its source.

    `firm`: whether the tuned gain is at most `high`, or at most its starting value if that is higher. `times`: name of
    another gain of the law; the range is then that of the product of both gains.
    """

    low: float
    high: float
    source: str
    firm: bool = False
    times: str = ""


def manifold(context: SearchContext) -> Interval:
    """Return the range of a decay rate on a sliding manifold, 1/s."""
    cap = max(1 / (5 * context.period), context.w / 10)
    if cap >= 10 * context.w:
        return Interval(context.w / 30, 10 * context.w, f"w/30 to 10 w, {context.pole}", True)
    words = (
        f"w/30 to the cap 1/(5 T), but at least w/10, T = {context.period:g} s: the sampled loop cannot slide faster; "
        f"{context.pole}"
    )
    return Interval(context.w / 30, cap, words, True)


def switch(context: SearchContext, name: str, p: Scalar, times: float, over: str) -> Interval:
    """Return the range of a switching gain from the slope 2/pi gain p of its smoothed sign.

    The range starts at twice the bound named `over`, or higher, and ends at 200 times this bound, or higher.
    """
    per, below = TWO_OVER_PI * float(p), context.bounds.get(over, 0.0)
    low, high = context.w / 3 / per, times * context.w / per
    words = f"slope 2/pi {name} p from w/3 to {times:g} w, {context.pole}"
    return _beyond(low, high, words, over, below)


def _beyond(low: float, high: float, words: str, over: str, below: float) -> Interval:
    """Return the range with its start at least 2 times, and its end at least 200 times, the bound `below`."""
    if 2 * below > low:
        words += f"; at least twice the disturbance bound {over} = {below:.3g}"
    if 200 * below > high:
        words += f"; up to 200 times the disturbance bound {over} = {below:.3g}"
    return Interval(max(low, 2 * below), max(high, 200 * below), words)


def authority(context: SearchContext, size: Scalar, share: tuple[float, float], what: str, over: str = "") -> Interval:
    """Return the range of a switching gain on a processor, where no slope limits it.

    `share`: ends of the range as shares of `size`; `what` describes `size`. The range starts at twice the bound named
    `over`, or higher, and ends at 200 times this bound, or higher.
    """
    below = context.bounds.get(over, 0.0)
    low, high = (part * float(size) for part in share)
    words = f"{share[0]:g} to {share[1]:g} of {float(size):.3g}, {what}"
    return _beyond(low, high, words, over, below)


def position_switch(context: SearchContext, p: Scalar | None) -> Interval:
    """Return the range of the switching gain k of a position law. `p`: steepness of its sign; None: set-valued."""
    if p is not None and not context.stepped:
        return switch(context, "k", p, 100, "Q_z")
    most = context.w**2 * float(context.model.s_0)
    return authority(
        context, most, (1e-3, 0.3), "w^2 s_0: the acceleration by the negative stiffness over one gap", "Q_z"
    )


def steepness(context: SearchContext, name: str) -> dict[str, Interval]:
    """Return {"p": range of the product of the gain `name` and the steepness p}; {} unless the signs are implicit."""
    if not context.stepped:
        return {}
    low, high = (slope / TWO_OVER_PI for slope in (context.w / 3, 10 / context.period))
    words = f"slope 2/pi {name} p from w/3 to 10/T, which is nearly set-valued; {context.pole}"
    return {"p": Interval(low, high, words, times=name)}


def rate(context: SearchContext, low: float, high: float, words: str, per: Scalar = 1.0, power: int = 1) -> Interval:
    """Return the range of a gain for which gain times `per`, in (1/s)^power, is (low w)^power to (high w)^power."""
    first, last = ((share * context.w) ** power / float(per) for share in (low, high))
    return Interval(first, last, f"{words}, {context.pole}")
