"""Sensors, their runout and faults, and the reading that an observer receives.

For example:

    from ambjax import Scenario, sensors

    Scenario(sensor=sensors.Sensor(std=1e-7, outliers=sensors.Outliers(rate=1.0)))
"""

from ambjax.world.faults import Dropouts, Outliers
from ambjax.world.rotation import Harmonic, Runout
from ambjax.world.sensor import Measurement, Sensor

__all__ = ["Dropouts", "Harmonic", "Measurement", "Outliers", "Runout", "Sensor"]
