"""Names for custom laws, plants and metrics, in addition to those of the other namespaces.

Laws subclass `Observer`, `PositionLaw`, `InversionLaw` or `CurrentLaw`; plants subclass `Bearing`. Both are records:
frozen dataclasses whose fields are declared by `gain`, `leaf` or `static`. A metric is a `Fold` over the rows of a run,
such as `Peak` or `Rms` of a signal, or several `Named` folds.
"""

from ambjax.compiler.fast_path import one_kernel
from ambjax.control.base import Law, Requirement
from ambjax.control.force import force_for, linear_mechanics, sliding_variable
from ambjax.control.machine_law import Demanded, MachineInputs, MachineLaw, demand_of
from ambjax.control.sampling import Relay
from ambjax.control.search import Interval, SearchContext, manifold, rate
from ambjax.control.stages import (
    CurrentDemand,
    CurrentInputs,
    CurrentLaw,
    ForceDemand,
    InversionLaw,
    Observer,
    PositionLaw,
    Relaxation,
)
from ambjax.numerics.records import GAINS, Scalar, canonical, gain, leaf, record, static, validate
from ambjax.numerics.relax import share
from ambjax.numerics.smooth import TWO_OVER_PI, smooth_sign
from ambjax.simulation.folds import Fold, Lowest, Named, Peak, Rms
from ambjax.simulation.trajectory import Row, Span, Trajectory
from ambjax.world.bearing import Bearing, Signals
from ambjax.world.rotor import Rotor
from ambjax.world.waveforms import Reference, Signal, reference_at

__all__ = [
    "GAINS",
    "TWO_OVER_PI",
    "Bearing",
    "CurrentDemand",
    "CurrentInputs",
    "CurrentLaw",
    "Demanded",
    "Fold",
    "ForceDemand",
    "Interval",
    "InversionLaw",
    "Law",
    "Lowest",
    "MachineInputs",
    "MachineLaw",
    "Named",
    "Observer",
    "Peak",
    "PositionLaw",
    "Reference",
    "Relaxation",
    "Relay",
    "Requirement",
    "Rms",
    "Rotor",
    "Row",
    "Scalar",
    "SearchContext",
    "Signal",
    "Signals",
    "Span",
    "Trajectory",
    "canonical",
    "demand_of",
    "force_for",
    "gain",
    "leaf",
    "linear_mechanics",
    "manifold",
    "one_kernel",
    "rate",
    "record",
    "reference_at",
    "share",
    "sliding_variable",
    "smooth_sign",
    "static",
    "validate",
]
