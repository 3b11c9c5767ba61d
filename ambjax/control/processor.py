"""The processor of a cascade: all laws make one step per sample, and their voltage acts after a delay."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ambjax.control.guard import Guard
from ambjax.control.sampling import Sampling
from ambjax.numerics.declared import check_number, leaves_of
from ambjax.numerics.linear import rk4_step
from ambjax.numerics.records import Scalar, bounded, derived, is_traced, part, record, replaced, static
from ambjax.world.plant import Plant, State
from ambjax.world.sensor import Measurement

# Largest delay, samples.
MOST_DELAY = 10.0
# Every program keeps the commands for this delay (samples) at least: an exported plant or a page admits it.
USUAL_DELAY = 2.0


@record
class Processor:
    """Delay, discretisation, prediction and guard of a sampled cascade. The clock gives the sample period T.

    At t_n = n T the sensors are read and every law makes one step. The resulting voltage acts from t_n + delay T to
    t_{n+1} + delay T. Before t_0 + delay T, u = 0. With `predict`, all laws except the observer use the state that the
    nominal model predicts for the end of the delay, and the reference at that instant. `assumed` is the delay over
    which the model predicts, if it differs from the true delay.
    """

    delay: Scalar = bounded(1.0, "samples", 0, MOST_DELAY, "time from the reading until the voltage acts")
    implicit: bool = static(
        default=True, doc="implicit steps, which evaluate signs at the end of the step; otherwise explicit Euler steps"
    )
    predict: bool | None = static(
        default=None, doc="whether the laws use the estimate predicted over the delay; None: True if there is a delay"
    )
    assumed: Scalar | None = bounded(
        None, "samples", 0, MOST_DELAY, "delay that the prediction assumes; none: the true delay"
    )
    guard: Guard | None = part(default=Guard(), doc="guard of the readings; None: every reading is accepted")
    # Of `resolved`: whether every delay is a whole number of samples, the samples over which the longest prediction
    # extends, and the number of past commands that the program keeps.
    whole: bool | None = derived()
    most: int | None = derived()
    kept: int | None = derived()

    def __str__(self) -> str:
        ahead = "with" if self.predicts else "without"
        return f"{'implicit' if self.implicit else 'explicit'} steps, a delay of {self.delay:g} T, {ahead} prediction"

    @property
    def ahead(self) -> Scalar:
        """Horizon of the prediction, samples."""
        return self.delay if self.assumed is None else self.assumed

    @property
    def predicts(self) -> bool:
        """Whether the laws use a prediction over the delay."""
        return bool(self.resolved().most) if self.predict is None else self.predict

    def sampling(self, period: Scalar) -> Sampling:
        """Return the sampling of the laws, with the delay that the prediction does not cover. `period`: s."""
        late = float(self.delay) - (float(self.ahead) if self.predicts else 0.0)
        return Sampling(float(period), max(late, 0.0), self.implicit)

    def resolved(self, *others: Scalar, between: bool = False) -> "Processor":
        """Return this processor with `whole`, `most` and `kept` set. These fields select the compiled program.

        The program supports the processor's own delay and the delays `others`; with `between`, also every delay between
        them. Larger numbers `most` and `kept`, and a `whole` that is False, are not changed. A part of an ensemble thus
        runs the same program as the whole ensemble. Raises ValueError for a number in `others` that is no delay, and if
        a delay is traced and `most` is None.
        """
        for other in others:
            check_number(leaves_of(Processor)[0], "delay", other)
        traced = "delay" if is_traced(self.delay) else "assumed"
        if is_traced(getattr(self, traced)):
            if self.most is None:
                raise ValueError(
                    f"processor.{traced} is traced (jit, grad or vmap), so its value cannot select the program. "
                    "Call cascade.on_processor() before the transformation."
                )
            return self
        delay = np.concatenate([np.ravel(np.asarray(x, float)) for x in (self.delay, *others)])
        whole = self.whole is not False and not between and bool(np.all(delay == np.round(delay)))
        longest = math.ceil(delay.max())
        ahead = longest if self.assumed is None else math.ceil(np.max(np.asarray(self.assumed)))
        most = max(self.most or 0, ahead)
        kept = max(self.kept or 0, most, longest, math.ceil(USUAL_DELAY))
        return replaced(self, whole=whole, most=most, kept=kept)

    def supported(self, whole: bool = False) -> Array:
        """Return whether the program of `resolved` has room for this delay and this horizon of the prediction.

        `whole`: whether the program also needs a whole number of samples, if the field `whole` says so.
        """
        own, (delay, ahead) = self.resolved(), map(jnp.asarray, (self.delay, self.ahead))
        fits = (delay >= 0) & (delay <= (own.kept or 0))
        fits &= (ahead >= 0) & (ahead <= (own.most or 0)) if own.predicts else True
        return fits & (delay == jnp.round(delay)) if whole and own.whole else fits

    def remembered(self, u: Array, *past: Array) -> tuple[Array, ...]:
        """Return the past commands of the next sample. `u`, `past`: the command of this sample and those before it."""
        return (u, *past)[: self.resolved().kept]

    def constant_past(self, u: Array) -> tuple[Array, ...]:
        """Return the past commands of a loop whose command has always been u."""
        return (u,) * int(self.resolved().kept or 0)

    def prediction_steps(self, period: Scalar) -> tuple[Array, ...]:
        """Return the durations (s) for which u_{n-1}, u_{n-2}, ... act in the prediction; the last one acts first."""
        ahead = jnp.asarray(self.ahead)
        shares = [jnp.minimum(jnp.maximum(ahead - lag, 0.0), 1.0) for lag in range(self.resolved().most or 0)]
        return tuple(share * period for share in shares)


def predicted_over_delay(
    model: Plant,
    driven: Callable[[Array, State], State],
    estimate: Measurement,
    past: tuple[Array, ...],
    lengths: tuple[Array, ...],
) -> Measurement:
    """Return the estimate at the end of the delay. The model makes one RK4 step per command, the earliest first.

    `driven`: `Cascade.driven`. `past`: the commands u_{n-1}, u_{n-2}, ... `lengths`: durations for which they act, s.
    """
    count, start = len(lengths), model.start(estimate)

    def moved(loop: tuple[State, tuple[Array, ...], tuple[Array, ...]], _: None) -> tuple[Any, None]:
        x, past, lengths = loop
        x = rk4_step(functools.partial(driven, past[-1]), x, lengths[-1])
        return (x, (past[-1], *past[:-1]), (lengths[-1], *lengths[:-1])), None

    loop = (start, past[:count], lengths)
    if count <= USUAL_DELAY:
        for _ in range(count):
            loop, _ = moved(loop, None)
    else:  # a loop, so that the program does not grow with the delay
        loop, _ = lax.scan(moved, loop, None, count)
    return model.measurement(loop[0])
