"""A rotor levitated by an active magnetic bearing under a cascaded sliding-mode controller, differentiable.

Names are imported when they are first used, so that what needs none of them (`ambjax --version`) does not wait for JAX.
"""

import importlib
import sys
import types
from typing import TYPE_CHECKING, Any

from ambjax._version import __version__

if TYPE_CHECKING:
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

# Where each public name comes from; tests/test_startup.py holds this table to the imports above.
_NAMES = {
    "control": "current inversion observer position",
    "control.cascade": "Cascade",
    "explicit": "DOP853 RK4 Euler",
    "integrate": "Adaptive Rodas3 Slide",
    "method": "choose_method with_method",
    "metrics": "Standard",
    "plant": "Plant",
    "rollout": "Outcome rollout",
    "scenario": "Clock Initial Scenario Sensor",
    "signals": "BandNoise Chirp Constant Pulse Sine SmoothStep Step Sum",
    "trajectory": "Row Trajectory",
}
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'ambjax' has no attribute '{name}'")
    home = f"ambjax.{_HOME[name]}"
    if home == "ambjax.control":  # its modules are the names
        return importlib.import_module(f"{home}.{name}")
    return getattr(importlib.import_module(home), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Package(types.ModuleType):
    """This package, in which `rollout` is the function and never the module of that name."""

    def __setattr__(self, name: str, value: Any) -> None:
        # The import system binds every submodule to its package once it is loaded.
        if name in _HOME and isinstance(value, types.ModuleType):
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
