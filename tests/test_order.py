"""The order of the stages: what is measured reaches the laws through the observer, and only so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax import Cascade, Sine, observer, position
from ambjax.control.laws import Measurement
from ambjax.signals import reference_at


@pytest.mark.parametrize("law", [position.SlidingMode(), position.SuperTwisting()], ids=lambda law: type(law).__name__)
def test_the_laws_see_the_rotor_where_the_observer_says_it_is(law):
    """Behind an observer with an estimate of its own the measured position changes nothing at once but its rate."""
    cascade, reference = Cascade(observer.Complementary(l=7.0), law), reference_at(Sine(2.5e-3, 2.0), 0.013)
    state = cascade.init(Measurement(jnp.asarray(2e-4), jnp.asarray(0.0), jnp.asarray(0.0)))

    def told(z, estimate):
        command, rates = cascade(Measurement(z, 3e-3, 0.02), state._replace(observer=estimate), reference, 200.0)
        return jnp.stack([command.v_star, command.v_tilde, command.i_ref_dot, command.u]), rates.observer

    measured, estimated = jax.jacfwd(lambda *x: told(*x)[0], (0, 1))(1e-4, 2e-4)
    np.testing.assert_array_equal(measured, np.zeros(4))
    assert np.all(np.abs(estimated) > 1.0)  # stiff laws: the slopes are of order 1e3 and more
    np.testing.assert_allclose(jax.jacfwd(lambda *x: told(*x)[1], (0, 1))(1e-4, 2e-4), (7.0, -7.0), rtol=1e-12)
