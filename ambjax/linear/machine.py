"""Linearisation of a whole machine at rest and at constant speed: all loops are closed, every axis has a test signal."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from ambjax.control.cascade_state import Sample
from ambjax.linear.analysis import Zones
from ambjax.linear.equilibrium import TOLERANCE, at_rest, ideal, newton_of, reading, sizes_of, start_of
from ambjax.linear.margins import ResponsePeak, peak, poles_in_s, whole_end
from ambjax.linear.state_space import StateSpace
from ambjax.numerics.records import Scalar, canonical
from ambjax.numerics.small_matrices import exponential
from ambjax.simulation.machine import Machine, MachineState, SampledMachine


class AxisSensitivity(NamedTuple):
    """Peaks of an axis: of |S_kk| with its zone, of |T_kk| (1), and of |KS_kk| (V/m, or A/m for a commanded current)."""

    name: str
    S: ResponsePeak
    T: ResponsePeak
    KS: ResponsePeak
    zone: str


class MachineSensitivity(NamedTuple):
    """Sensitivity of a machine at one speed, with all loops closed.

    - `speed`: rpm. `stable`: whether no mode grows. If one does, the peaks have no physical meaning, and zones are D.
    - `axes`: the peaks of each axis. `sigma`: peak of the largest singular value of the matrix S.
    - `poles`: poles of the machine, 1/s, in the order of decreasing real part.
    - `system`: the linear system, with inputs e_k at the sensors, and outputs: readings z_k, then commands u_k.
    """

    speed: float
    stable: bool
    axes: tuple[AxisSensitivity, ...]
    sigma: ResponsePeak
    poles: np.ndarray
    system: StateSpace

    @property
    def worst(self) -> AxisSensitivity:
        """The axis with the largest peak of |S_kk|."""
        return max(self.axes, key=lambda axis: axis.S.height)


class _Rest(NamedTuple):
    """A point of the machine: coordinates [n], states of the axes' plants and laws, and commands [c]."""

    q: Array
    plant: Any
    control: Any
    u: Array


class _Linear:
    """The machine at constant speed without what a linear system cannot contain (`ideal`), with test signals e [c]."""

    def __init__(self, machine: Machine, W: Scalar, period: Scalar):
        self.machine, self.W, self.period = machine.realised(), W, period
        loop = self.machine.loops()
        self.scenario: Any = jax.vmap(ideal)(loop.scenario)
        cascade = loop.cascade
        if cascade.processor is not None:
            cascade = dataclasses.replace(cascade, processor=dataclasses.replace(cascade.processor, guard=None))
        self.cascade: Any = cascade
        self.rotor = machine.rotor
        self.count = len(jnp.asarray(self.rotor.at_magnets))
        sensor, amplifier = self.scenario.sensor, self.scenario.amplifier
        self.low_passed = sensor is not None and sensor.bandwidth is not None
        self.lagged = amplifier is not None and amplifier.slow

    def plants(self, rows: Array, q: Array, q_dot: Array, plant: Any) -> Any:
        return plant._replace(z=jnp.sum(rows * q, -1), z_dot=jnp.sum(rows * q_dot, -1))

    def start(self) -> _Rest:
        """Return the machine at q = 0, where the axes carry the weight."""
        def one(cascade: Any, scenario: Any) -> Any:
            return start_of(cascade, scenario, self.period, 0.0)

        point = jax.vmap(one)(self.cascade, self.scenario)
        return _Rest(jnp.zeros_like(jnp.asarray(self.rotor.gravity)), _bare(point.plant), point.control, point.u)

    def sizes(self, start: _Rest) -> _Rest:
        def one(cascade: Any, scenario: Any) -> Any:
            return sizes_of(cascade, scenario, start_of(cascade, scenario, self.period, 0.0))

        own = jax.vmap(one)(self.cascade, self.scenario)
        size, _ = self.machine.scales(own.plant)
        return jax.tree.map(lambda x, s: jnp.zeros_like(x) + s, start, _Rest(size, _bare(own.plant), own.control, own.u))

    def sensed(self, q: Array, q_dot: Array, plant: Any, z: Any, e: Array) -> Any:
        """Return the readings of all axes. `z`: outputs of the low-passes, or () without."""
        at = self.plants(self.rotor.at_sensors, q, q_dot, plant)

        def one(scenario: Any, plant: Any, z: Any, e: Array) -> Any:
            motion = scenario.plant.measurement(plant)
            return reading(scenario, motion if isinstance(z, tuple) else motion._replace(z=z), (e, 0.0))

        return jax.vmap(one)(self.scenario, at, z, e)

    def rates(self, q: Array, q_dot: Array, plant: Any, u: Array) -> Any:
        """Return the rates of (q, q_dot, plant) under voltages or commanded currents u [c]."""
        at = self.plants(self.rotor.at_magnets, q, q_dot, plant)

        def one(scenario: Any, plant: Any, u: Array) -> Any:
            return scenario.plant.rates(plant, scenario.coil_voltage(u, plant))

        moved = jax.vmap(one)(self.scenario, at, u)
        outside = jnp.asarray(self.rotor.gravity), self.W
        return self.machine.coupled(outside, MachineState(q, q_dot, None), _Plant(moved), self.scenario.plant)

    def laws(self, measured: Any, control: Any, past: Any) -> tuple[Array, Any]:
        """Return the commands [c], and the next states of the laws, or their rates in continuous time."""
        def one(cascade: Any, measured: Any, control: Any, past: Any) -> Any:
            if cascade.processor is None:
                command, rates = cascade(measured, control, at_rest(0.0), jnp.asarray(jnp.inf))
                return command.u, rates
            command, after, _ = cascade.step(measured, control, Sample(at_rest(0.0), self.period, jnp.asarray(jnp.inf), past))
            return command.u, after

        return jax.vmap(one)(self.cascade, measured, control, past)

    def constant_past(self, u: Array) -> Any:
        return () if self.cascade.processor is None else self.cascade.processor.constant_past(u)

    def residual(self, point: _Rest) -> _Rest:
        zero, e = jnp.zeros_like(point.q), jnp.zeros(self.count)
        moved = self.rates(point.q, zero, point.plant, point.u)
        pole = self.scenario.plant.pole
        z = jnp.sum(self.rotor.at_sensors * point.q, -1) if self.low_passed else ()
        measured = self.sensed(point.q, zero, point.plant, z, e)
        u, after = self.laws(measured, point.control, self.constant_past(point.u))
        if self.cascade.processor is None:
            change = jax.tree.map(lambda x: x / pole, after)
        else:
            change = jax.tree.map(lambda a, b: b - a, point.control, after)
        plant = jax.tree.map(lambda x: x / pole, _bare(moved.axes.plant))
        return _Rest(moved.q_dot / jnp.max(pole) ** 2, plant, change, u - point.u)

    def rest(self) -> tuple[_Rest, _Rest, Array]:
        """Return the equilibrium, its sizes, and whether it was found."""
        start = self.start()
        sizes = self.sizes(start)
        scale, (flat, restore) = ravel_pytree(sizes)[0], ravel_pytree(start)
        newton = newton_of(lambda y: ravel_pytree(self.residual(restore(y * scale)))[0] / scale, flat / scale)
        return restore(newton.y * scale), sizes, newton.error <= TOLERANCE * jnp.finfo(flat.dtype).eps

    def system(self) -> tuple[StateSpace, Array]:
        """Return the state space, and whether an equilibrium was found."""
        point, sizes, found = self.rest()
        z = jnp.sum(self.rotor.at_sensors * point.q, -1)
        z_size = jnp.sum(jnp.abs(self.rotor.at_sensors) * sizes.q, -1)
        lags = {"z": z if self.low_passed else (), "u": point.u if self.lagged else ()}
        lag_sizes = {"z": z_size if self.low_passed else (), "u": sizes.u if self.lagged else ()}
        body, restore = ravel_pytree((point.q, jnp.zeros_like(point.q), point.plant, lags))
        body_sizes = ravel_pytree((sizes.q, sizes.q * jnp.max(self.scenario.plant.pole), sizes.plant, lag_sizes))[0]

        def moved(x: Array, u: Array) -> Array:
            q, q_dot, plant, lags = restore(x)
            own, lag_rates = u, {"z": (), "u": ()}
            if self.low_passed:
                z = jnp.sum(self.rotor.at_sensors * q, -1)
                lag_rates["z"] = 2 * jnp.pi * self.scenario.sensor.bandwidth * (z - lags["z"])
            if self.lagged:
                lag_rates["u"], own = self.scenario.amplifier.slope() * (u - lags["u"]), lags["u"]
            after = self.rates(q, q_dot, plant, own)
            return ravel_pytree((after.q, after.q_dot, _bare(after.axes.plant), lag_rates))[0]

        def read(x: Array, e: Array) -> Any:
            q, q_dot, plant, lags = restore(x)
            return self.sensed(q, q_dot, plant, lags["z"], e)

        build = self._sampled if isinstance(self.machine, SampledMachine) else self._continuous
        matrices, scale = build(point, sizes, body, body_sizes, moved, read)
        (A, B), (C, D) = matrices
        period = jnp.asarray(self.period) if isinstance(self.machine, SampledMachine) else None
        return StateSpace(A, B, C, D, scale, period), found

    def _continuous(self, point: _Rest, sizes: _Rest, body: Array, body_sizes: Array, moved: Any, read: Any) -> Any:
        x, restore = ravel_pytree((body, point.control))

        def field(x: Array, e: Array) -> tuple[Array, Array]:
            at, control = restore(x)
            measured = read(at, e)
            u, rates = self.laws(measured, control, ())
            return ravel_pytree((moved(at, u), rates))[0], jnp.concatenate([measured.z, u])

        scale = ravel_pytree((body_sizes, sizes.control))[0]
        return jax.jacfwd(field, (0, 1))(x, jnp.zeros(self.count, x.dtype)), scale

    def _sampled(self, point: _Rest, sizes: _Rest, body: Array, body_sizes: Array, moved: Any, read: Any) -> Any:
        processor = self.cascade.processor
        past = self.constant_past(point.u)
        transition, driven = _held(*jax.jacfwd(moved, (0, 1))(body, point.u), self.period, processor.delay[0], len(past))
        x, restore = ravel_pytree((body, point.control, past))

        def step(x: Array, e: Array) -> tuple[Array, Array]:
            at, control, past = restore(x)
            measured = read(at, e)
            u, after = self.laws(measured, control, past)
            commands = (u, *past)
            end = transition @ at + sum(effect @ one for effect, one in zip(driven, commands, strict=True))
            return ravel_pytree((end, after, commands[: len(past)]))[0], jnp.concatenate([measured.z, u])

        scale = ravel_pytree((body_sizes, sizes.control, self.constant_past(sizes.u)))[0]
        return jax.jacfwd(step, (0, 1))(x, jnp.zeros(self.count, x.dtype)), scale


class _Plant(NamedTuple):
    plant: Any


def _bare(plant: Any) -> Any:
    return plant._replace(z=(), z_dot=())


def _held(A: Array, B: Array, period: Scalar, delay: Scalar, kept: int) -> tuple[Array, list[Array]]:
    """Return the map of one sample [N, N], and the effects [N, c] of the command of each sample, the newest first.

    The command of a sample acts from `delay` samples after it until one sample later. `kept`: number of past commands.
    """
    n, c = B.shape
    table = jnp.zeros((n + c, n + c), A.dtype).at[:n].set(jnp.concatenate([A, B], 1) * period)
    delay = jnp.asarray(delay)
    whole = jnp.floor(delay)
    late, early = exponential(table * (1 - (delay - whole))), exponential(table * (delay - whole))
    new, old = late[:n, n:], late[:n, :n] @ early[:n, n:]
    at = lambda lag, number: jnp.where(jnp.abs(lag - number) < 0.5, 1.0, 0.0)  # noqa: E731
    driven = [at(whole + 1, lag) * old + at(whole, lag) * new for lag in range(kept + 1)]
    return late[:n, :n] @ early[:n, :n], driven


@jax.jit
def _matrices(machine: Machine, W: Scalar, period: Scalar) -> tuple[StateSpace, Array]:
    return _Linear(machine, W, period).system()


def linearise_machine(machine: Machine, period: Scalar, speed: float) -> StateSpace:
    """Linearise a machine at its equilibrium at a constant speed (rpm). `period`: sample period, s.

    The linear system has a test signal e_k at the sensor of each axis as its inputs, and the readings z_k and the
    commands u_k as its outputs. It contains what that of one axis contains (`linearise`). Raises ValueError if no
    equilibrium is found, and if a law has no derivative there.
    """
    system, found = _matrices(*canonical((machine, speed * np.pi / 30, period)))
    if not found:
        raise ValueError(
            "no equilibrium of the machine was found, so it has no linearisation: `ambjax simulate` shows whether the "
            "rotor is held."
        )
    if not all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(system)):
        raise ValueError("the machine has no linearisation: the derivative of a law or of a magnet is not finite.")
    return system.without_idle()


def machine_sensitivity(
    machine: Machine, names: tuple[str, ...], period: Scalar, speed: float, zones: Zones
) -> MachineSensitivity:
    """Return the sensitivity of a machine at a constant speed (rpm). `names`: of the axes. Raises as `linearise_machine`.
    """
    system, c = linearise_machine(machine, period, speed), len(names)
    end = whole_end(system)
    low, high = zones.range(None if system.period is None else float(system.period), max(end, 2 * float(zones.f_low)))
    stable, one = system.stable, np.eye(c)

    def largest(magnitude: Any) -> ResponsePeak:
        return peak(system, lambda f: magnitude(np.asarray(system.response(f))), low, high, end)

    axes = []
    for k, name in enumerate(names):
        S = largest(lambda H, k=k: np.abs(H[:, k, k]))
        T = largest(lambda H, k=k: np.abs(H[:, k, k] - 1))
        KS = largest(lambda H, k=k: np.abs(H[:, c + k, k]))
        axes.append(AxisSensitivity(name, S, T, KS, zones.zone(S.height) if stable else "D"))
    sigma = largest(lambda H: np.linalg.norm(H[:, :c], 2, axis=(1, 2)) * one[0, 0])
    poles = poles_in_s(system)
    return MachineSensitivity(speed, stable, tuple(axes), sigma, poles[np.argsort(-np.real(poles))], system)
