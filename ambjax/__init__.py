"""Differentiable simulation of an active-magnetic-bearing rotor under a cascaded sliding-mode controller.

Public names are imported on first use, so that `import ambjax` and `ambjax --version` do not import JAX.
"""

import importlib
from typing import TYPE_CHECKING, Any

from ambjax._version import __version__

if TYPE_CHECKING:
    from ambjax.control import current, inversion, observer, position
    from ambjax.control.cascade import Cascade
    from ambjax.control.processor import Processor
    from ambjax.simulation.clock import Clock
    from ambjax.simulation.explicit import DOP853, RK4, Euler
    from ambjax.simulation.integrate import AdaptiveRodas3, Rodas3, Slide
    from ambjax.simulation.method import choose_method, with_method
    from ambjax.simulation.metrics import Standard
    from ambjax.simulation.rollout import Outcome, rollout
    from ambjax.simulation.trajectory import Row, Trajectory
    from ambjax.world.amplifier import Amplifier
    from ambjax.world.coils import TwoCoil
    from ambjax.world.plant import Plant
    from ambjax.world.scenario import Initial, Scenario
    from ambjax.world.sensor import Sensor
    from ambjax.world.signals import BandNoise, Chirp, Constant, Pulse, Sine, SmoothStep, Step, Sum

__all__ = [
    "DOP853",
    "RK4",
    "AdaptiveRodas3",
    "Amplifier",
    "BandNoise",
    "Cascade",
    "Chirp",
    "Clock",
    "Constant",
    "Euler",
    "Initial",
    "Outcome",
    "Plant",
    "Processor",
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
    "TwoCoil",
    "__version__",
    "choose_method",
    "current",
    "inversion",
    "observer",
    "position",
    "rollout",
    "with_method",
]

# Public names by module. Static checkers read the imports above; tests/test_startup.py compares the two.
_NAMES = {
    "control": "current inversion observer position",
    "control.cascade": "Cascade",
    "control.processor": "Processor",
    "simulation.clock": "Clock",
    "simulation.explicit": "DOP853 RK4 Euler",
    "simulation.integrate": "AdaptiveRodas3 Rodas3 Slide",
    "simulation.method": "choose_method with_method",
    "simulation.metrics": "Standard",
    "simulation.rollout": "Outcome rollout",
    "simulation.trajectory": "Row Trajectory",
    "world.amplifier": "Amplifier",
    "world.coils": "TwoCoil",
    "world.plant": "Plant",
    "world.scenario": "Initial Scenario",
    "world.sensor": "Sensor",
    "world.signals": "BandNoise Chirp Constant Pulse Sine SmoothStep Step Sum",
}
# Packages available as attributes of ambjax, imported on first use.
_PACKAGES = ("ensemble", "paper")
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name in _PACKAGES:
        return importlib.import_module(f"ambjax.{name}")
    if name not in _HOME:
        raise AttributeError(f"module 'ambjax' has no attribute '{name}'")
    home = f"ambjax.{_HOME[name]}"
    if home == "ambjax.control":  # these names are modules
        return importlib.import_module(f"{home}.{name}")
    return getattr(importlib.import_module(home), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_PACKAGES})
