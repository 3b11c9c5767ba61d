"""The processor that a cascade runs on: one step of all laws a sample, its voltage held, late by a delay."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.compiler.barrier import materialised
from ambjax.control.guard import Guard
from ambjax.numerics.records import Scalar, is_traced, leaf, record, static
from ambjax.world.plant import Plant, State
from ambjax.world.sensor import Measurement

# Samples.
MOST_DELAY = 2.0


@record
class Processor:
    """How a cascade runs where it is sampled. The period is the clock's.

    At t_n = n T the sensors are read and every law makes a step; its voltage acts from t_n + delay T until
    t_{n+1} + delay T; before the first, u = 0. With `predict` the laws act on the estimate carried over the delay by
    the nominal model, and on the reference of that instant. `assumed` is for a prediction that does not know the delay.
    """

    delay: Scalar = leaf(
        default=1.0,
        unit="samples",
        at_least=0,
        at_most=MOST_DELAY,
        doc="from measurement to voltage, computing and output",
    )
    implicit: bool = static(default=True, doc="signs act on the step's end; else explicit Euler")
    predict: bool | None = static(default=None, doc="carry the estimate over the delay; None: where there is one")
    assumed: Scalar | None = leaf(
        default=None,
        unit="samples",
        at_least=0,
        at_most=MOST_DELAY,
        optional=True,
        doc="delay that the prediction assumes; none: the delay itself",
    )
    guard: Guard | None = Guard()
    """of the readings; None: every reading is believed"""
    whole: bool | None = static(default=None, doc="every delay is a whole number of samples; None: to be seen")
    most: int | None = static(default=None, doc="samples that the longest prediction reaches into; None: to be seen")

    def __str__(self) -> str:
        ahead = "with" if self.predicts else "without"
        return f"{'implicit' if self.implicit else 'explicit'} steps, a delay of {self.delay:g} T, {ahead} prediction"

    @property
    def ahead(self) -> Scalar:
        """Samples over which the estimate is carried where the processor predicts."""
        return self.delay if self.assumed is None else self.assumed

    @property
    def predicts(self) -> bool:
        """Whether the estimate is carried over the delay."""
        return bool(self.resolved().most) if self.predict is None else self.predict

    def resolved(self, *others: Scalar, between: bool = False) -> "Processor":
        """This processor with everything settled that decides which program is compiled; for `others`, delays, too.

        `between`: for whatever lies between them as well, which need not be whole samples.

        What was settled before for longer delays stays: a part of an ensemble runs the program of the whole.
        Raises ValueError where the delay is traced and that was not settled before.
        """
        if is_traced(self.delay):
            if self.most is None:
                raise ValueError(
                    "processor.delay: inside jit, grad or vmap it is traced, and no program can be chosen. Call "
                    "cascade.on_processor() outside."
                )
            return self
        delay = np.concatenate([np.ravel(np.asarray(x, float)) for x in (self.delay, *others)])
        whole = self.whole is not False and not between and bool(np.all(delay == np.round(delay)))
        longest = float(delay.max()) if self.assumed is None else MOST_DELAY
        most = max(self.most or 0, math.ceil(longest))
        return dataclasses.replace(self, whole=whole, most=most)

    def stretches(self, period: Scalar) -> tuple[Array, ...]:
        """Lengths (s) of the parts of the prediction over which one voltage acts: u_{n-1}, and before it u_{n-2}."""
        ahead = jnp.asarray(self.ahead)
        return (jnp.minimum(ahead, 1.0) * period, jnp.maximum(ahead - 1.0, 0.0) * period)[: self.most]


def carried(model: Plant, estimate: Measurement, past: tuple[Array, Array], lengths: tuple[Array, ...]) -> Measurement:
    """The estimate after these lengths (s), the last first, under past voltages: one RK4 step of the model each."""

    def rates(x: State, u: Array) -> State:
        return materialised(model.rates(x, u), x)

    x = model.start(estimate)
    for u, h in reversed(list(zip(past, lengths, strict=False))):
        k_1 = rates(x, u)
        k_2 = rates(_moved(x, h / 2, k_1), u)
        k_3 = rates(_moved(x, h / 2, k_2), u)
        k_4 = rates(_moved(x, h, k_3), u)
        x = materialised(_moved(x, h / 6, jax.tree.map(lambda a, b, c, d: a + 2 * (b + c) + d, k_1, k_2, k_3, k_4)))
    return model.measurement(x)


def _moved(x: State, h: Array, rates: State) -> State:
    return jax.tree.map(lambda a, b: a + h * b, x, rates)
