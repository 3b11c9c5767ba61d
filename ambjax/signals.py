"""Signals in time: references, loads and disturbances of a `Scenario`.

For example:

    from ambjax import Scenario, signals

    Scenario(reference=signals.Sine(1e-4, 20.0), q_z=signals.Step(0.5, start=0.1))
"""

from ambjax.world.ramps import Ramp, Trapezoid
from ambjax.world.recorded import BandNoise, Recorded, Samples
from ambjax.world.rotation import Rotation, Unbalance, UnbalanceGrade
from ambjax.world.waveforms import Chirp, Constant, Pulse, Sine, SmoothStep, Step, Sum

__all__ = [
    "BandNoise",
    "Chirp",
    "Constant",
    "Pulse",
    "Ramp",
    "Recorded",
    "Rotation",
    "Samples",
    "Sine",
    "SmoothStep",
    "Step",
    "Sum",
    "Trapezoid",
    "Unbalance",
    "UnbalanceGrade",
]
