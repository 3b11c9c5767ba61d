"""Linear analysis of the closed loop at an equilibrium: sensitivity, margins, stiffness, poles.

    from ambjax.linear import analyse, linearise

    system = linearise(case)  # or linearise(cascade, scenario, clock)
    system.sensitivity(np.array([100.0]))  # S at 100 Hz, complex
    analyse(system, case.scenario.plant.m, case.clock.sample_period).margins.pm

A test signal e is added to the reading of the position sensor, after low-pass and converter: e_n at sample n, or e(t)
in continuous time. S is the transfer function from e to the reading that the controller receives, T = S - 1 that from e
to the sensor's own reading, and KS that from e to u.

`injected` measures S, T and KS in the nonlinear simulation, `injected_members` the peak of |S| of each member.
"""

from ambjax.linear.analysis import Analysis, Zones, analyse, checked, linearisation_inputs, linearise, linearise_members
from ambjax.linear.differentiable import LoopQuantities, loop_quantities
from ambjax.linear.injection import Injection, MemberPeaks, frequency_lines, injected, injected_members
from ambjax.linear.linear_machine import MachineSensitivity, linearise_machine, machine_rest, machine_sensitivity
from ambjax.linear.machine_injection import machine_injected
from ambjax.linear.margins import (
    LoopMargins,
    Margins,
    ResponsePeak,
    decayed_end,
    margins_of,
    noise_gain,
    peak,
    poles_in_s,
)
from ambjax.linear.matrices import loop_matrices
from ambjax.linear.stability import Findings, Stability, stability_of, suspects
from ambjax.linear.state_space import INPUTS, OUTPUTS, PLACES, StateSpace

__all__ = [
    "INPUTS",
    "OUTPUTS",
    "PLACES",
    "Analysis",
    "Findings",
    "Injection",
    "LoopMargins",
    "LoopQuantities",
    "MachineSensitivity",
    "Margins",
    "MemberPeaks",
    "ResponsePeak",
    "Stability",
    "StateSpace",
    "Zones",
    "analyse",
    "checked",
    "decayed_end",
    "frequency_lines",
    "injected",
    "injected_members",
    "linearisation_inputs",
    "linearise",
    "linearise_machine",
    "linearise_members",
    "loop_matrices",
    "loop_quantities",
    "machine_injected",
    "machine_rest",
    "machine_sensitivity",
    "margins_of",
    "noise_gain",
    "peak",
    "poles_in_s",
    "stability_of",
    "suspects",
]
