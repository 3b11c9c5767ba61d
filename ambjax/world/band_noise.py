"""Band-limited noise: a random signal."""

import math
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.numerics.records import Scalar, leaf, record
from ambjax.numerics.smooth import TWO_PI, sine

# Number of sines in one realisation of band-limited noise. Its fourth moment is less than that of a Gaussian signal by
# (1.5/LINES) std^4.
LINES = 32


@record
class Lines:
    """Sum of n sines: std sqrt(2/n) sum(sin(2 pi frequencies t + phases)), with frequencies in Hz and phases in rad."""

    std: Scalar
    frequencies: Array
    phases: Array

    def __call__(self, t: Scalar) -> Array:
        turns = self.frequencies * jnp.asarray(t)[..., None] + self.phases / TWO_PI
        return self.std * math.sqrt(2 / self.phases.size) * jnp.sum(sine(turns), axis=-1)


@record
class BandNoise:
    """Stationary band-limited noise: constant power density over f_low..f_high (Hz), standard deviation `std`.

    The signal of a member is a sum of LINES sines. Each sine has a random phase, and a random frequency in one of LINES
    equal parts of the band (after Shinozuka and Deodatis, Appl. Mech. Rev. 44, 1991). The autocovariance over members
    is exactly std^2 times the mean of cos(2 pi f tau) over the frequencies f of the band. The signal is smooth, so
    integrators keep their order.

    Use it for a random load, such as that of a flow or a floor: `Scenario(q_f=signals.BandNoise(2.0, 10.0, 500.0))`.
    """

    std: Scalar = leaf(at_least=0, at_most=1e20, doc="standard deviation")
    f_low: Scalar = leaf(unit="Hz", at_least=0, at_most=1e9, doc="lower end of the band")
    f_high: Scalar = leaf(unit="Hz", above=0, at_most=1e9, doc="upper end of the band, above f_low")
    ordered: ClassVar = ("f_low", "f_high")

    def realised(self, key: Array) -> Lines:
        """Draw the signal of one member."""
        place, turn = jax.random.uniform(key, (2, LINES))
        share = (jnp.arange(LINES) + place) / LINES
        return Lines(self.std, self.f_low + (self.f_high - self.f_low) * share, 2 * jnp.pi * turn)

    def __call__(self, t: Scalar) -> Array:
        raise ValueError(
            "band-noise: the signal of one member is a function of time, but it is not drawn yet. Call "
            "scenario.realised() first, as a rollout does."
        )

    def span(self, end: float) -> tuple[float, float]:
        crest = math.sqrt(2 * LINES) * float(np.max(self.std))  # all sines at their crests at once: 8 std
        return -crest, crest
