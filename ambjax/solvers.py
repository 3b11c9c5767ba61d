"""Integration methods of a `Clock`, and their choice.

For example:

    from ambjax import Clock, solvers

    Clock(samples=2000, sample_period=1e-4, method=solvers.RK4(4))
"""

from ambjax.simulation.explicit import DOP853, RK4, AdaptiveCashKarp, Euler
from ambjax.simulation.method import choose_method, with_method
from ambjax.simulation.rosenbrock import AdaptiveRodas3, Rodas3
from ambjax.simulation.sliding import Slide

__all__ = [
    "DOP853",
    "RK4",
    "AdaptiveCashKarp",
    "AdaptiveRodas3",
    "Euler",
    "Rodas3",
    "Slide",
    "choose_method",
    "with_method",
]
