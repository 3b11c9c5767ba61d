"""Linear analysis of the closed loop at an equilibrium: sensitivity, margins, stiffness, poles.

`injected` measures the sensitivity in the nonlinear simulation instead.

    from ambjax.linear import analyse, linearise

    system = linearise(cascade, scenario, clock)
    system.sensitivity(np.array([100.0]))  # S at 100 Hz, complex
    analyse(system).margins.phase_deg

At sample n a number e_n is added to what the position sensor reports, after converter and filter. S is what the
controller reads per e, T = S - 1 what the plant adds, and KS = u/e. In continuous time the same holds with e(t).
"""

from ambjax.linear.analysis import Analysis, Zones, analyse, linearise, linearise_members, prepared
from ambjax.linear.differentiable import LoopQuantities, loop_quantities
from ambjax.linear.injection import Injection, injected, lines
from ambjax.linear.margins import Margins, ResponsePeak, margins_of, noise_gain, peak
from ambjax.linear.matrices import loop_matrices
from ambjax.linear.state_space import INPUTS, OUTPUTS, StateSpace

__all__ = [
    "INPUTS",
    "OUTPUTS",
    "Analysis",
    "Injection",
    "LoopQuantities",
    "Margins",
    "ResponsePeak",
    "StateSpace",
    "Zones",
    "analyse",
    "injected",
    "linearise",
    "linearise_members",
    "lines",
    "loop_matrices",
    "loop_quantities",
    "margins_of",
    "noise_gain",
    "peak",
    "prepared",
]
