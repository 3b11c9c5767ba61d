"""The state of a cascade, its outputs, and its inputs at a sample."""

import math
from typing import Any, NamedTuple

from jax import Array

from ambjax.numerics.records import Scalar
from ambjax.world.waveforms import Reference


class CascadeState(NamedTuple):
    """The state of each law, or its rate."""

    observer: Any
    position: Any
    inversion: Any
    current: Any


class Command(NamedTuple):
    """Outputs of the stages.

    - `v_star`: demanded scaled force, A^2/m^2. Eq. (5)
    - `v_tilde`: inversion error v_star - v(z, i_ref), A^2/m^2.
    - `i_ref`, `i_ref_dot`: current reference, A, and its rate, A/s.
    - `u`: voltage, V, or current, A, before its limit.
    """

    v_star: Array
    v_tilde: Array
    i_ref: Array
    i_ref_dot: Array
    u: Array


class Sample(NamedTuple):
    """Inputs of a cascade at a sample of a processor or, in continuous time, at an instant, apart from the measurement.

    - `reference`: at the instant of the sample; with prediction, at the end of the delay.
    - `period`: sample period, s; None: continuous time.
    - `u_max`: limit of u, V or A.
    - `past`: u of the samples before, the most recent first, as many as the delay needs, V or A.
    """

    reference: Reference
    period: Scalar | None = None
    u_max: Scalar = math.inf
    past: tuple[Array, ...] = ()
