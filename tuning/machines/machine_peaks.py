"""The largest peak of |S_kk| of a machine over its axes and speeds, and its derivatives in the gains."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.cases.machine_case import MachineCase
from ambjax.compiler.short_compilation import QUICK, supported
from ambjax.extend import canonical
from ambjax.linear.linear_machine import machine_loop, machine_rest
from ambjax.linear.machine_at_speed import MachineRest
from ambjax.linear.margins import STATIC
from ambjax.linear.notch_design import machine_at_speed
from ambjax.linear.state_space import NEUTRAL, StateSpace
from ambjax.simulation.whole_machine import Machine
from ambjax.world.rotation import PER_MINUTE
from tuning.machines.machine_gains import LqgSpace, MachineSpace

# Offsets of the frequencies beside each light pole, in units of its damping.
BESIDE = (-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0)


class Value(NamedTuple):
    """A point [m], the value of a function there, and its gradient [m]. A value of inf has no gradient."""

    x: np.ndarray
    f: float
    gradient: np.ndarray


class Loop(NamedTuple):
    """A linear system in NumPy without idle states, its derivatives `moves` [.., m], eigenvalues and eigenvectors."""

    system: StateSpace
    moves: StateSpace
    values: np.ndarray
    vectors: np.ndarray


class Peaks:
    """Evaluation of the nominal machine of a case at its speeds.

    `stability` and `peak` are functions of coordinates [m]. Both give a `Value`: the largest growth rate of a pole
    (1/s); the logarithm of the largest peak of |S_kk|, inf if a pole grows.
    """

    def __init__(self, case: MachineCase, space: MachineSpace | LqgSpace) -> None:
        self.count, self.period, self.zones = len(case.axes), float(case.clock.sample_period), case.zones
        machine, self.sampled = canonical(case.machine), case.cases[0].cascade.sampled
        self.speeds = 2 * np.pi * PER_MINUTE * np.array(case.speeds)
        speeds = jnp.asarray(self.speeds)

        def systems(machine: Machine, rests: MachineRest) -> StateSpace:
            def one(at: tuple[Array, MachineRest]) -> StateSpace:
                found = machine_loop(machine_at_speed(machine, at[0], self.period), at[0], self.period, at[1]).scaled()
                return found._replace(C=found.C[: self.count], D=found.D[: self.count], period=None)

            return jax.lax.map(one, (speeds, rests))

        self._both: Callable[[np.ndarray], tuple[StateSpace, StateSpace]]
        quick = supported(QUICK)
        if isinstance(space, LqgSpace):  # the weights do not move the rotor
            each = [machine_rest(machine, self.period, W) for W in speeds]
            rests = jax.tree.map(lambda *own: jnp.stack(own), *each)
            compiled = jax.jit(systems, compiler_options=quick)
            self._both = lambda x: _differences(lambda x: compiled(space.decode(x, machine), rests), x)
        else:  # the machine is an argument, because constants are not arrays of JAX

            def at(x: Array, machine: Machine) -> tuple[StateSpace, StateSpace]:
                own = space.decode(x, machine)
                found = systems(own, jax.lax.map(lambda W: machine_rest(own, self.period, W), speeds))
                return found, found

            both = jax.jit(jax.jacfwd(at, has_aux=True), compiler_options=quick)
            self._both = lambda x: both(jnp.asarray(x), machine)[::-1]
        self._last: tuple[np.ndarray, list[Loop]] | None = None

    def loops(self, x: np.ndarray) -> list[Loop]:
        """Return the loops at coordinates x [m], one for each speed."""
        if self._last is None or not np.array_equal(self._last[0], x):
            found = jax.tree.map(np.asarray, self._both(x))
            each = [jax.tree.map(lambda a, k=k: a[k], found) for k in range(len(found[0].A))]
            self._last = x.copy(), [_loop(*one) for one in each]
        return self._last[1]

    def rates(self, loop: Loop) -> np.ndarray:
        """Return the poles, 1/s."""
        values = np.asarray(loop.values, complex)
        return np.log(np.where(values == 0, 1e-300, values)) / self.period if self.sampled else values

    def stability(self, x: np.ndarray) -> Value:
        """Return the largest growth rate of a pole at any speed."""
        rates = [self.rates(loop) for loop in self.loops(x)]
        n = int(np.argmax([np.max(np.real(one)) for one in rates]))
        loop, k = self.loops(x)[n], int(np.argmax(np.real(rates[n])))
        if not np.isfinite(rates[n][k]):
            return Value(x, np.inf, np.zeros(len(x)))
        left, right = np.linalg.inv(loop.vectors)[k], loop.vectors[:, k]
        slope = np.einsum("i,ijm,j->m", left, loop.moves.A, right)
        slope = slope / (loop.values[k] * self.period) if self.sampled else slope
        return Value(x, float(rates[n][k].real), slope.real)

    def stable(self, value: Value) -> bool:
        """Return whether no pole grows, with the tolerance of `StateSpace.stable`. `value`: a `stability`."""
        fastest = 1 / self.period if self.sampled else max(np.abs(loop.values).max() for loop in self.loops(value.x))
        return value.f <= NEUTRAL * fastest

    def peak(self, x: np.ndarray) -> Value:
        """Return the logarithm of the largest peak of |S_kk| of any axis at any speed."""
        if not self.stable(self.stability(x)):
            return Value(x, np.inf, np.zeros(len(x)))
        best: tuple[Any, ...] = (0.0,)
        for loop in self.loops(x):
            at = self._points(self.rates(loop))
            S = self._response(loop, at)
            k, axis = np.unravel_index(np.argmax(np.abs(S)), S.shape)
            best = max(best, (abs(S[k, axis]), at[k], int(axis), loop, S[k, axis]), key=lambda one: one[0])
        height, at, axis, loop, S = best
        return Value(x, float(np.log(height)), np.real(np.conj(S) * self._slope(loop, at, axis)) / height**2)

    def turning(self, x: np.ndarray) -> float:
        """Return the largest |S_kk| of any axis at the frequency of a speed; 0 if the rotor turns at none."""
        loops = [(loop, 1j * abs(W)) for loop, W in zip(self.loops(x), self.speeds, strict=True) if W]
        at = [(loop, np.array([np.exp(s * self.period) if self.sampled else s])) for loop, s in loops]
        return max((float(np.abs(self._response(*one)).max()) for one in at), default=0.0)

    def _points(self, rates: np.ndarray) -> np.ndarray:
        """Return the points s or z at which S is evaluated: 250 over its range, and some beside light poles.

        A pole is light if its damping ratio is below 0.3.
        """
        size = np.maximum(np.abs(rates), 1e-12)
        end = max(1e4, size.max() / 2, 2 * float(self.zones.f_low))
        period = self.period if self.sampled else None
        low, high = self.zones.whole(period).range(period, end)
        damping = -np.real(rates) / size
        light = (np.imag(rates) > 0) & (damping < 0.3)
        beside = np.outer(size[light] / (2 * np.pi), np.ones(len(BESIDE))) * (1 + np.outer(damping[light], BESIDE))
        f = np.concatenate([np.geomspace(low, high, 250), beside.ravel()])
        s = 2j * np.pi * np.unique([STATIC * low, *f[(f >= low) & (f <= high)]])
        return np.exp(s * self.period) if self.sampled else s

    def _response(self, loop: Loop, at: np.ndarray) -> np.ndarray:
        """Return S_kk [points, axes]."""
        _, B, C, D, *_ = loop.system
        own = C @ loop.vectors, np.linalg.solve(loop.vectors, B)
        return np.einsum("ck,fk,kc->fc", own[0], 1 / (at[:, None] - loop.values), own[1]) + np.diagonal(D)

    def _slope(self, loop: Loop, at: complex, axis: int) -> np.ndarray:
        """Return the derivatives [m] of S_kk of an axis at a point."""
        (A, B, C, *_), moves = loop.system, loop.moves
        matrix = at * np.eye(len(A)) - A
        right, left = np.linalg.solve(matrix, B[:, axis] + 0j), np.linalg.solve(matrix.T, C[axis] + 0j)
        moved = np.einsum("i,ijm,j->m", left, moves.A, right)
        return moves.D[axis, axis] + right @ moves.C[axis] + left @ moves.B[:, axis] + moved


def _loop(system: StateSpace, moves: StateSpace) -> Loop:
    kept, finite = ~np.asarray(system.idle()), np.isfinite(system.A).all()
    system, moves = (one._replace(A=one.A[kept][:, kept], B=one.B[kept], C=one.C[:, kept]) for one in (system, moves))
    if not finite:
        return Loop(system, moves, np.array([np.inf]), np.eye(1))
    return Loop(system, moves, *np.linalg.eig(system.A))


def _differences(systems: Callable[[np.ndarray], StateSpace], x: np.ndarray) -> tuple[StateSpace, StateSpace]:
    """Return the systems at x [m] and their derivatives [.., m] by forward differences."""
    now, step = systems(x), 1e-6
    each = [jax.tree.map(lambda a, b: (b - a) / step, now, systems(x + step * one)) for one in np.eye(len(x))]
    return now, jax.tree.map(lambda *own: np.stack(own, -1), *each)
