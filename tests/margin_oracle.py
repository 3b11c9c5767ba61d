"""Stability of linearised loops with a factor and a delay at the reading or at the command, by the poles themselves.

The loop is put together from the derivatives of the laws and of the plant. It shares no code with `ambjax.linear`,
except for the equilibrium.
"""

import dataclasses
import itertools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.linalg import expm
from scipy.special import factorial

from ambjax.control.cascade_state import Sample
from ambjax.linear.analysis import linearisation_inputs
from ambjax.linear.equilibrium import equilibrium, ideal
from ambjax.world.waveforms import Constant, reference_at

# Order of the Pade approximation of a delay in continuous time. Its error is below 1e-6 up to a phase of pi.
PADE = 8


class Change(NamedTuple):
    """Factors (complex) and additional delays (s) at the reading of the position and at the command."""

    reading: complex = 1.0
    command: complex = 1.0
    late_reading: float = 0.0
    late_command: float = 0.0


@dataclasses.dataclass
class Parts:
    """The linear parts of a loop.

    `A`, `b`, `c`: of the plant, from the command to (z, z_dot, i). `laws`: matrix from (z, z_dot, i, states, past
    commands) to (command, next states, or their rates). `states`: number of states of the laws. `period`: sample
    period, s; None in continuous time. `delay`: of the processor, samples. `past`: number of past commands.
    """

    A: np.ndarray
    b: np.ndarray
    c: np.ndarray
    laws: np.ndarray
    states: int
    period: float | None
    delay: float
    past: int

    def stable(self, change: Change) -> bool:
        """Return whether all poles of the changed loop are stable."""
        if self.period is None:
            return bool(np.real(np.linalg.eigvals(self._continuous(change))).max() < 0)
        return bool(np.abs(np.linalg.eigvals(self._sampled(change))).max() < 1)

    def _sampled(self, change: Change) -> np.ndarray:
        """Return the matrix of one sample. State: plant, laws, commands from u_{n-1} on, earlier positions."""
        T, nx = self.period, len(self.b)
        whole_u, part_u = divmod(round(self.delay + change.late_command / T, 12), 1.0)
        whole_z, part_z = divmod(round(change.late_reading / T, 12), 1.0)
        commands, positions = max(int(whole_u) + 1, self.past), int(whole_z) + 1
        n = nx + self.states + commands + positions
        x, laws, past, read = np.split(np.eye(n, dtype=complex), np.cumsum([nx, self.states, commands]))
        motion = self.c @ x
        motion[0] = change.reading * read[int(whole_z)]
        after = self.laws @ np.concatenate([motion, laws, past[: self.past]])
        past = np.concatenate([after[:1], past])  # u_n, u_{n-1}, ...
        cuts, position = sorted({0.0, part_u, 1 - part_z, 1.0}), None
        for begin, end in itertools.pairwise(cuts):
            acting = past[int(whole_u) + (begin < part_u)] * change.command
            step = expm(np.block([[self.A, self.b[:, None]], [np.zeros((1, nx + 1))]]) * (end - begin) * T)
            x = step[:nx, :nx] @ x + step[:nx, nx:] @ acting[None]
            if end == 1 - part_z:
                position = self.c[:1] @ x
        return np.concatenate([x, after[1:], past[:commands], position, read[:-1]])

    def _continuous(self, change: Change) -> np.ndarray:
        """Return the matrix of the rates. State: plant, laws, and the states of the delays."""
        late_z, late_u = (pade(t) for t in (change.late_reading, change.late_command))
        nx, nz = len(self.b), len(late_z[0])
        n = nx + self.states + nz + len(late_u[0])
        x, laws, past_z, past_u = np.split(np.eye(n, dtype=complex), np.cumsum([nx, self.states, nz]))
        motion = self.c @ x
        true = motion[:1].copy()
        motion[0] = change.reading * (late_z[2] @ past_z + late_z[3] * true)[0]
        after = self.laws @ np.concatenate([motion, laws, np.zeros((self.past, n))])
        u = change.command * (late_u[2] @ past_u + late_u[3] * after[:1])
        moved = self.A @ x + self.b[:, None] @ u
        return np.concatenate(
            [moved, after[1:], late_z[0] @ past_z + late_z[1] @ true, late_u[0] @ past_u + late_u[1] @ after[:1]]
        )


def pade(delay):
    """A, B, C, D of the Pade approximation of a delay (s); without states for a delay of 0."""
    from scipy.signal import tf2ss

    if not delay:
        return np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), 1.0
    k = np.arange(PADE + 1)
    size = factorial(2 * PADE - k) / (factorial(k) * factorial(PADE - k))
    A, B, C, D = tf2ss((size * (-1.0) ** k)[::-1], size[::-1])  # in the unit of the delay
    return A / delay, B / delay, C, D[0, 0]


def parts_of(cascade, scenario, clock, r=0.0):
    """Linearise the laws and the plant at the equilibrium of the constant reference r (m)."""
    cascade, scenario, period = linearisation_inputs(cascade, scenario, clock)
    scenario, sampled, plant = ideal(scenario), cascade.processor is not None, scenario.plant
    if sampled:
        cascade = dataclasses.replace(cascade, processor=dataclasses.replace(cascade.processor, guard=None))
    point, found, *_ = equilibrium(cascade, scenario, period, r)
    assert found
    state, restore = ravel_pytree(point.plant)
    laws, restore_laws = ravel_pytree(point.control)
    reference, limit = reference_at(Constant(r), 0.0), jnp.asarray(jnp.inf)
    late = max(1, math.ceil(cascade.processor.delay)) if sampled else 1

    def driven(x, u):
        x = restore(x)
        return ravel_pytree(plant.rates(x, scenario.coil_voltage(u, x)))[0]

    def motion(x):
        return jnp.stack(plant.measurement(restore(x)))

    def control(y):
        measured = plant.measurement(point.plant)._replace(z=y[0], z_dot=y[1], i=y[2])
        states, past = restore_laws(y[3:-late]), tuple(y[-late:])
        if sampled:
            command, after, _ = cascade.step(measured, states, Sample(reference, period, limit, past))
        else:
            command, after = cascade(measured, states, reference, limit)
        return jnp.concatenate([command.u[None], ravel_pytree(after)[0]])

    y = jnp.concatenate([motion(state), laws, jnp.full(late, point.u)])
    A, b = jax.jit(jax.jacfwd(driven, (0, 1)))(state, point.u)
    c, law = jax.jit(jax.jacfwd(motion))(state), jax.jit(jax.jacfwd(control))(y)
    numbers = [np.asarray(one) for one in (A, b, c, law)]
    if scenario.sensor is not None and scenario.sensor.bandwidth is not None:
        w = 2 * np.pi * float(scenario.sensor.bandwidth)
        A, b, c = numbers[:3]
        A = np.block([[A, np.zeros((len(b), 1))], [w * c[:1], -w * np.ones((1, 1))]])
        c = np.block([c, np.zeros((3, 1))])
        c[0] = np.eye(len(A))[-1]
        numbers[:3] = A, np.append(b, 0.0), c
    if scenario.actuator.slow and scenario.drive == "voltage":
        w, (A, b, c) = 2 * np.pi * float(scenario.actuator.bandwidth), numbers[:3]
        A = np.block([[A, b[:, None]], [np.zeros((1, len(b))), -w * np.ones((1, 1))]])
        numbers[:3] = A, np.append(0 * b, w), np.block([c, np.zeros((3, 1))])
    delay = float(cascade.processor.delay) if sampled else 0.0
    return Parts(*numbers, len(laws), float(period) if sampled else None, delay, late)
