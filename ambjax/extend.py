"""Names for custom laws and plants, in addition to those of `ambjax`.

Laws subclass `Observer`, `PositionLaw`, `InversionLaw` or `CurrentLaw`; plants subclass `Bearing`. Both are records:
frozen dataclasses whose fields are declared by `gain`, `leaf` or `static`.
"""

from ambjax.compiler.fast_path import one_kernel
from ambjax.control.base import Law, Requirement
from ambjax.control.force import force_for, sliding_variable
from ambjax.control.laws import (
    CurrentDemand,
    CurrentInputs,
    CurrentLaw,
    ForceDemand,
    InversionLaw,
    Observer,
    PositionLaw,
    Relaxation,
)
from ambjax.control.sampling import Relay
from ambjax.control.search import Interval, SearchContext, manifold, rate
from ambjax.numerics.records import GAINS, Scalar, canonical, gain, leaf, record, static, validate
from ambjax.numerics.relax import share
from ambjax.numerics.smooth import TWO_OVER_PI, smooth_sign
from ambjax.world.bearing import Bearing, Signals
from ambjax.world.sensor import Measurement
from ambjax.world.signals import Reference, Signal

__all__ = [
    "GAINS",
    "TWO_OVER_PI",
    "Bearing",
    "CurrentDemand",
    "CurrentInputs",
    "CurrentLaw",
    "ForceDemand",
    "Interval",
    "InversionLaw",
    "Law",
    "Measurement",
    "Observer",
    "PositionLaw",
    "Reference",
    "Relaxation",
    "Relay",
    "Requirement",
    "Scalar",
    "SearchContext",
    "Signal",
    "Signals",
    "canonical",
    "force_for",
    "gain",
    "leaf",
    "manifold",
    "one_kernel",
    "rate",
    "record",
    "share",
    "sliding_variable",
    "smooth_sign",
    "static",
    "validate",
]
