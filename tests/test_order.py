"""The order of the stages: measurements reach the laws only through the observer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ambjax import Cascade
from ambjax.laws import inversion, observer
from ambjax.signals import Sine
from ambjax.world.sensor import Measurement
from ambjax.world.waveforms import reference_at


@pytest.mark.slow
@pytest.mark.parametrize("law", [inversion.Adaptive(), inversion.ClosedForm()], ids=lambda law: type(law).__name__)
def test_the_laws_use_the_estimate_of_the_observer(law):
    """The observer has its own estimate of the position.

    The measured position then changes rates only, not the commands at the same instant.
    """
    cascade = Cascade(observer.Complementary(l=7.0), inversion=law)
    reference = reference_at(Sine(2.5e-3, 2.0), 0.013)
    state = cascade.init(Measurement(jnp.asarray(2e-4), jnp.asarray(0.0), jnp.asarray(0.0)))

    def outputs(z, estimate):
        command, rates = cascade(Measurement(z, 3e-3, 0.02), state._replace(observer=estimate), reference, 200.0)
        decided = [command.v_star, command.v_tilde, command.i_ref]
        if isinstance(law, inversion.Adaptive):  # a static inversion passes the estimate's rate on to i_ref' and u
            decided += [command.i_ref_dot, command.u]
        return jnp.stack(decided), rates.observer

    (by_z, by_estimate), rates = jax.jacfwd(outputs, (0, 1))(1e-4, 2e-4)
    np.testing.assert_array_equal(by_z, 0.0 * by_z)
    assert abs(by_estimate[0]) > 1.0
    np.testing.assert_allclose(rates, (7.0, -7.0), rtol=1e-12)
