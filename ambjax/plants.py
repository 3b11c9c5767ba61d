"""Bearings and what belongs to them: coils, iron, and the stop of a touchdown bearing.

For example:

    from ambjax import Scenario, plants

    Scenario(plant=plants.TwoCoil(m=1.64, iron=plants.Iron(saturation=1.4)), stop=plants.Stop(stiffness=1e7))
"""

from ambjax.world.magnet import Iron
from ambjax.world.plant import Plant, TwoCoil
from ambjax.world.touchdown import Stop

__all__ = ["Iron", "Plant", "Stop", "TwoCoil"]
