"""A rotor levitated by an active magnetic bearing under a cascaded sliding-mode controller, differentiable."""

from ambjax._version import __version__
from ambjax.control import current, inversion, observer, position
from ambjax.control.cascade import Cascade
from ambjax.explicit import DOP853, RK4, Euler
from ambjax.integrate import Adaptive, Rodas3, Slide
from ambjax.method import choose_method, with_method
from ambjax.metrics import Standard
from ambjax.plant import Plant
from ambjax.rollout import Outcome, rollout
from ambjax.scenario import Clock, Initial, Scenario, Sensor
from ambjax.signals import BandNoise, Chirp, Constant, Pulse, Sine, SmoothStep, Step, Sum
from ambjax.trajectory import Row, Trajectory

__all__ = [
    "DOP853",
    "RK4",
    "Adaptive",
    "BandNoise",
    "Cascade",
    "Chirp",
    "Clock",
    "Constant",
    "Euler",
    "Initial",
    "Outcome",
    "Plant",
    "Pulse",
    "Rodas3",
    "Row",
    "Scenario",
    "Sensor",
    "Sine",
    "Slide",
    "SmoothStep",
    "Standard",
    "Step",
    "Sum",
    "Trajectory",
    "__version__",
    "choose_method",
    "current",
    "inversion",
    "observer",
    "position",
    "rollout",
    "with_method",
]
