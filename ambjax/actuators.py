"""Amplifiers and the limits of coils.

For example:

    from ambjax import Scenario, actuators

    Scenario(u_max=48.0, amplifier=actuators.Amplifier(bandwidth=2e3))
"""

from ambjax.world.amplifier import Amplifier, CoilLimits, CurrentAmplifier

__all__ = ["Amplifier", "CoilLimits", "CurrentAmplifier"]
