"""Laws of a controller by stage, and gains that depend on a signal.

    from ambjax import Cascade, laws

    Cascade(observer=laws.observer.Kalman(), position=laws.position.PID())

`ambjax.extend` has the base classes for custom laws.
"""

from ambjax.control import current, inversion, observer, position
from ambjax.control.schedule import Schedule

__all__ = ["Schedule", "current", "inversion", "observer", "position"]
