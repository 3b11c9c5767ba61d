"""The delay margin at the command as a differentiable function, as `held_command` computes it with NumPy."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from ambjax.linear.held_command import PARTS, TURNS
from ambjax.linear.state_space import StateSpace
from ambjax.numerics.records import Scalar
from ambjax.numerics.small_matrices import exponential

# Number of frequencies of the scan, of starts of Newton's method, and of its steps.
POINTS, STARTS, STEPS = 240, 8, 8
# Largest |log(-L)| at a solution.
SOLVED = 1e-5
# Delay margin of a loop without one, times the lowest frequency.
NONE = 1e12
# GRID: number of equal parts of a sample for which the hold is computed. TERMS: degree of the Taylor polynomial for the
# rest, whose relative error is below 1e-12 for rates up to GRID/4 per sample.
GRID, TERMS = 64, 9


def command_delay(system: StateSpace, low: Scalar, high: Scalar) -> Array:
    """Return the smallest additional delay (s) of the command that makes a stable loop unstable; NONE/low if none does.

    `system`: a result of `StateSpace.scaled`. `low`, `high`: frequencies of the scan, Hz; on a processor, `high` is
    half the sampling rate.
    """
    loop = _Command(lax.stop_gradient(system))
    f, late, valid = loop.starts(jnp.geomspace(low, high, POINTS))
    f, late, error, slopes = lax.stop_gradient(jax.vmap(loop.newton)(f, late))
    valid &= (late > 0) & (f <= high * (1 + SOLVED)) & (jnp.max(jnp.abs(error), 1) < SOLVED)
    k = jnp.argmin(jnp.where(valid, late, jnp.inf))
    # one more Newton step: its derivative is that of the implicit function
    slopes = jnp.where(valid[k], slopes[k], jnp.eye(2))
    step = _solved(slopes, jnp.where(valid[k], _Command(system).residual(f[k], late[k]), 0.0))[1]
    return jnp.where(valid[k], loop.unit * (late[k] - step), NONE / low)


def _solved(A: Array, b: Array) -> Array:
    """Return x [2] with A x = b, by Cramer's rule. See `small_matrices` for the reason not to call LAPACK."""
    return jnp.stack([b[0] * A[1, 1] - b[1] * A[0, 1], A[0, 0] * b[1] - A[1, 0] * b[0]]) / (
        A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    )


class _Command:
    """The loop transfer L broken at the command; late is an additional delay in samples, or s in continuous time."""

    def __init__(self, system: StateSpace):
        path = system.known_path
        self.system, self.n, self.b = system, len(path.b), path.b
        self.sampled = system.period is not None
        self.unit = jnp.asarray(1.0 if system.period is None else system.period)
        self.own = jnp.asarray(path.delay if self.sampled else 0.0)
        if self.sampled:
            table = jnp.zeros((self.n + 1, self.n + 1), path.A.dtype)
            self.rates = table.at[: self.n].set(jnp.concatenate([path.A, path.b[:, None]], 1)) * self.unit / GRID
            part = exponential(self.rates)
            self.powers = lax.scan(lambda x, _: (x @ part, x), jnp.eye(self.n + 1, dtype=part.dtype), None, GRID + 1)[1]
            self.whole = jnp.floor(self.own)
            self.nominal = self.held(self.own - self.whole)

    def power(self, part: Any) -> Array:
        """Return exp of the rates over a part of a sample."""
        k = jnp.clip(jnp.floor(part * GRID), 0, GRID)
        rest, total = self.rates * (part * GRID - k), jnp.eye(self.n + 1, dtype=self.rates.dtype)
        for term in range(TERMS, 0, -1):
            total = jnp.eye(self.n + 1, dtype=self.rates.dtype) + rest @ total / term
        return self.powers[k.astype(int)] @ total

    def held(self, part: Any) -> tuple[Array, Array]:
        """Return the effects [n] of the new command and of the one before it, as `CommandPath.held` does."""
        late, early = self.power(1 - part), self.power(part)
        return late[: self.n, self.n], late[: self.n, : self.n] @ early[: self.n, self.n]

    def row(self, f: Array) -> Array:
        """Return the row [F, n] whose product with the effect of the command is L."""
        row = self.system.command_row(f)
        own = jnp.broadcast_to(self.b, row.shape)
        if self.sampled:
            own = self.nominal[0] + self.turned(f, 1.0)[:, None] * self.nominal[1]
            own = self.turned(f, self.whole)[:, None] * own
        return -row / (1 + jnp.sum(row * own, -1))[:, None]

    def turned(self, f: Array, delay: Any) -> Array:
        """Return the factor [F] of a delay (samples, or s in continuous time)."""
        return jnp.exp(-2j * jnp.pi * f * self.unit * delay)

    def residual(self, f: Array, late: Array) -> Array:
        """Return the real and imaginary parts of log(-L) at one frequency (Hz), which are 0 at a solution."""
        row, f = self.row(f[None])[0], f[None]
        if self.sampled:
            delay = self.own + late
            new, before = self.held(delay - jnp.floor(delay))
            L = self.turned(f, jnp.floor(delay))[0] * (row @ new + self.turned(f, 1.0)[0] * (row @ before))
        else:
            L = self.turned(f, late)[0] * (row @ self.b)
        error = jnp.log(-L)
        return jnp.stack([jnp.real(error), jnp.imag(error)])

    def newton(self, f: Array, late: Array) -> tuple[Array, Array, Array, Array]:
        """Return the solution of L = -1 by Newton's method from this start, its residual, and the slopes there."""

        def both(x: Array) -> tuple[Array, Array]:
            found = self.residual(jnp.exp(x[0]), x[1])
            return found, found

        def step(_: int, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            x, slopes, error = state
            moved = x - _solved(slopes, error)
            moved = jnp.where(jnp.all(jnp.isfinite(moved)), jnp.clip(moved, x - 0.2, x + 0.2), x)
            return moved, *jax.jacfwd(both, has_aux=True)(moved)

        x = jnp.stack([jnp.log(f), late])
        x, slopes, error = lax.fori_loop(0, STEPS, step, (x, jnp.eye(2, dtype=x.dtype), jnp.zeros_like(x)))
        return jnp.exp(x[0]), x[1], error, slopes

    def starts(self, f: Array) -> tuple[Array, Array, Array]:
        """Return starts for Newton's method [STARTS], frequency (Hz) and late, and whether each is one.

        See `HeldCommand.delays`.
        """
        row, parts, slack = self.row(f), jnp.zeros(1), 0.0
        L = (row @ self.b)[:, None]
        if self.sampled:
            parts, slack = (jnp.arange(PARTS) + 0.5) / PARTS, 1 / PARTS
            new, before = jax.vmap(self.held)(parts)
            L = row @ new.T + (row @ before.T) * self.turned(f, 1.0)[:, None]
        size = jnp.log(jnp.abs(L))
        share = size[:-1] / (size[:-1] - size[1:])
        cross = f[:-1, None] * (f[1:] / f[:-1])[:, None] ** share
        lag = jnp.angle(-L[:-1]) + share * jnp.angle(L[1:] / L[:-1])
        turn = cross * self.unit
        whole = lag / (2 * jnp.pi * turn)
        whole += jnp.ceil((self.own - parts - slack - whole) * turn) / turn
        samples = whole + jnp.arange(TURNS)[:, None, None] / turn
        near = jnp.abs(samples - jnp.round(samples)) <= slack if self.sampled else jnp.ones(samples.shape, bool)
        late = jnp.where(near & (size[:-1] * size[1:] < 0), parts + samples - self.own, jnp.inf).ravel()
        f = jnp.broadcast_to(cross, samples.shape).ravel()
        if self.sampled:
            alternating = self.alternating()
            late, f = jnp.concatenate([late, alternating]), jnp.append(f, jnp.full(alternating.shape, 0.5 / self.unit))
        least, at = lax.top_k(-late, STARTS)
        valid = jnp.isfinite(least)
        return jnp.where(valid, f[at], 1.0), jnp.where(valid, -least, 0.0), valid

    def alternating(self) -> Array:
        """Return late near solutions at z = -1, where L is real; inf where there is none. See `HeldCommand`."""
        parts = jnp.arange(PARTS) / PARTS
        row = self.row(jnp.asarray([0.5 / self.unit]))[0]
        new, before = jax.vmap(self.held)(parts)
        L, whole = jnp.real(new @ row - before @ row), jnp.floor(self.own) + jnp.arange(4)
        distance = 1 + ((1 - 2 * (whole % 2))[:, None] * L).ravel()
        delay = (whole[:, None] + parts).ravel()
        share = distance[:-1] / (distance[:-1] - distance[1:])
        late = delay[:-1] + share / PARTS - self.own
        return jnp.where((distance[:-1] * distance[1:] < 0) & (late > -1 / PARTS), late, jnp.inf)
