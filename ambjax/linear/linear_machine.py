"""Linearisation of a whole machine at rest and constant speed: all loops are closed, each axis has a test signal."""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from ambjax.compiler.short_compilation import compiled_quickest
from ambjax.linear.analysis import Zones, largest_in
from ambjax.linear.equilibrium import TOLERANCE
from ambjax.linear.machine_at_speed import Groups, MachineAtSpeed, MachineRest, plants_of
from ambjax.linear.margins import NO_PEAK, Margins, ResponsePeak, margins_at, poles_in_s
from ambjax.linear.matrices import LagState
from ambjax.linear.state_space import CommandPath, StateSpace
from ambjax.numerics.records import Scalar, canonical
from ambjax.numerics.small_matrices import exponential, times
from ambjax.simulation.whole_machine import Machine, PlantOnly
from ambjax.world.scenario import Scenario


class AxisSensitivity(NamedTuple):
    """Peaks of an axis: of |S_kk| with its zone, of |T_kk| (1), and of |KS_kk| (V/m, or A/m for a current command).

    `margins`: of the loop broken at the reading of this axis, with the others closed; None if the machine is unstable.
    """

    name: str
    S: ResponsePeak
    T: ResponsePeak
    KS: ResponsePeak
    zone: str | None
    margins: Margins | None


class MachineSensitivity(NamedTuple):
    """Sensitivity of a machine at one speed, with all loops closed.

    - `speed`: rpm. `stable`: whether the machine is stable. `linear`: whether it is, and no mode of the linear
      machine grows. If not, the peaks are infinite, and the zones D, or None if the machine is stable.
    - `axes`: the peaks of each axis. `sigma`: peak of the largest singular value of the matrix S.
    - `poles`: poles of the machine, 1/s, in the order of decreasing real part.
    - `system`: the linear system, with inputs e_k at the sensors, and outputs as of `linearise_machine`.
    - `swing`: amplitude of a motion that does not decay in a run without noise and loads, m; None without one.
    """

    speed: float
    stable: bool
    linear: bool
    axes: tuple[AxisSensitivity, ...]
    sigma: ResponsePeak
    poles: np.ndarray
    system: StateSpace
    swing: float | None = None

    @property
    def swings(self) -> str:
        """The swing as part of a sentence."""
        return "" if self.swing is None else f"; without noise and loads, a motion of {self.swing:.3g} m does not decay"

    @property
    def worst(self) -> AxisSensitivity:
        """The axis with the largest peak of |S_kk|."""
        return max(self.axes, key=lambda axis: axis.S.height)


@compiled_quickest
def _at_rest(machine: Machine, W: Scalar, period: Scalar) -> MachineRest:
    return MachineAtSpeed(machine, W, period).rest(MachineAtSpeed(jax.lax.stop_gradient(machine), W, period))


@compiled_quickest
def _matrices(machine: Machine, W: Scalar, period: Scalar, point: MachineRest) -> tuple[StateSpace, Array, Array]:
    own = MachineAtSpeed(machine, W, period)
    deviation = own.deviation(point, ravel_pytree(own.start()[1])[0])
    rests = jnp.max(jnp.abs(deviation)) <= TOLERANCE * jnp.finfo(deviation.dtype).eps
    return *machine_matrices(own, point), rests


def machine_rest(machine: Machine, period: Scalar, W: Scalar = 0.0) -> MachineRest:
    """Return the equilibrium of a machine at the speed W (rad/s), or the point nearest to it that was found.

    It depends on the speed if gains do. At speed 0, a notch may keep a constant signal.
    """
    return _at_rest(machine, *canonical((W, period)))


def machine_loop(machine: Machine, W: Scalar, period: Scalar, point: MachineRest) -> StateSpace:
    """Return the linear system of `linearise_machine` at the speed W (rad/s) and at a known equilibrium.

    It works under jit, vmap and differentiation. States that no input reaches are not left out.
    """
    return machine_matrices(MachineAtSpeed(machine, W, period), point)[0]


class TurningMachine(NamedTuple):
    """The linear machine at one speed.

    - `system`: inputs e_k (m) at the sensor of each axis; outputs: readings z_k, commands u_k, currents i_k, and the
      coordinates q of the rotor. The first n states are q, the next n their rates.
    - `free` [N, N]: matrix A in continuous time, under constant commands, of the first N states: rotor, coils,
      low-passes and amplifiers.
    - `W`: speed, rad/s.
    """

    system: StateSpace
    free: np.ndarray
    W: float


def linearise_machine(machine: Machine, period: Scalar, speed: float) -> StateSpace:
    """Linearise a machine at its equilibrium at a constant speed (rpm). `period`: sample period, s.

    The linear system has a test signal e_k at the sensor of each axis as its inputs. Its outputs are the readings z_k,
    the commands u_k, the currents i_k and the coordinates of the rotor. It contains what that of one axis contains
    (`linearise`). Raises ValueError if no equilibrium is found, and if a law has no derivative there.
    """
    return next(turning_machines(machine, period, [speed])).system.without_idle()


def turning_machines(machine: Machine, period: Scalar, speeds: Iterable[float]) -> Iterator[TurningMachine]:
    """Linearise a machine at speeds (rpm) as `linearise_machine` does, with the states that no test signal reaches."""
    point, (machine, period) = None, canonical((machine, period))
    for speed in speeds:
        W = canonical(speed * np.pi / 30)
        found = None if point is None else _matrices(machine, W, period, point)
        if found is None or not found[-1]:  # the point of rest does not depend on the speed, or hardly
            point = _at_rest(machine, W, period)
            found = _matrices(machine, W, period, point)
        system, free, at_rest = found
        if not at_rest:
            raise ValueError(
                "no equilibrium of the machine was found, so it has no linearisation: `ambjax simulate` shows whether "
                "the rotor is held."
            )
        if not all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(system)):
            raise ValueError("the machine has no linearisation: the derivative of a law or of a magnet is not finite.")
        yield TurningMachine(jax.tree.map(np.asarray, system), np.asarray(free), float(W))


def machine_sensitivity(
    machine: Machine, names: tuple[str, ...], period: Scalar, speed: float, zones: Zones
) -> MachineSensitivity:
    """Return the sensitivity of a linear machine at a constant speed (rpm). Raises as `linearise_machine` does.

    `names`: of the axes. `period`: sample period, s. `zones`: frequency range and limits.
    """
    return sensitivity_of(next(turning_machines(machine, period, [speed])), names, speed, zones)


def sensitivity_of(
    point: TurningMachine,
    names: tuple[str, ...],
    speed: float,
    zones: Zones,
    stable: bool | None = None,
    swing: float | None = None,
) -> MachineSensitivity:
    """Return the sensitivity at a speed (rpm). `stable`, `swing`: by runs; None: the linear machine decides."""
    system, c = point.system.without_idle(), len(names)
    linear = system.stable
    stable = linear if stable is None else stable
    linear = linear and stable
    found = largest_in(system, zones)
    largest = found if linear else lambda _: NO_PEAK

    axes = []
    for k, name in enumerate(names):
        S = largest(lambda H, k=k: np.abs(H[:, k, k]))
        T = largest(lambda H, k=k: np.abs(H[:, k, k] - 1))
        KS = largest(lambda H, k=k: np.abs(H[:, c + k, k]))
        own = system._replace(B=system.B[:, [k]], C=system.C[[k]], D=system.D[[k]][:, [k]])
        margins = margins_at(own, "reading") if linear else None
        axes.append(AxisSensitivity(name, S, T, KS, zones.zone(S.height) if linear or not stable else None, margins))
    sigma = largest(lambda H: np.linalg.norm(H[:, :c], 2, axis=(1, 2)))
    return MachineSensitivity(speed, stable, linear, tuple(axes), sigma, poles_in_s(system), system, swing)


def machine_matrices(own: MachineAtSpeed, point: MachineRest) -> tuple[StateSpace, Array]:
    """Return the state space at a point, and its A under constant commands."""

    def lagging(u: Groups) -> Groups:
        return tuple(one if slow else () for one, slow in zip(u, own.lagged, strict=True))

    sizes, past = own.start()[1], own.past(point.u)
    start = point.q, jnp.zeros_like(point.q), point.plant, own.sensed(point.q), lagging(point.u)
    body, parts = ravel_pytree(start)
    fastest = jnp.max(own.machine.join([scenario.plant.pole for scenario in own.scenario]))
    low = own.machine.split(times(jnp.abs(own.rotor.at_sensors), sizes.q))
    low = tuple(one if on else () for one, on in zip(low, own.low_passed, strict=True))
    body_sizes = sizes.q, sizes.q * fastest, sizes.plant, low, lagging(sizes.u)
    x, restore = ravel_pytree((body, point.control, point.law, past))
    free = jax.jacfwd(lambda x, u: _body_rates(own, parts(x), own.machine.split(u)), (0, 1))
    A, B = free(body, own.machine.join(point.u))
    kept, transition, driven = len(past[0]), A, list[Array]()
    if own.sampled:
        delay = jnp.asarray(own.cascade[0].timing.delay)[0]
        transition, driven = exponential(A * own.period), CommandPath(A, B, delay).effects(own.period, kept)

    def step(x: Array, e: Array) -> tuple[Array, Array]:
        at, control, law, past = restore(x)
        q, q_dot, plant, filtered, _ = parts(at)
        measured = own.read(q, q_dot, plant, filtered, own.machine.split(e))
        u, after, law = own.laws(measured, control, law, past)
        commands = [(new, *old) for new, old in zip(u, past, strict=True)]
        if own.sampled:
            late = [own.machine.join([one[lag] for one in commands]) for lag in range(kept + 1)]
            moved = transition @ at + sum(effect @ one for effect, one in zip(driven, late, strict=True))
        else:
            moved = _body_rates(own, parts(at), u)
        z, i = (own.machine.join([getattr(one, name) for one in measured]) for name in ("z", "i"))
        outputs = jnp.concatenate([z, own.machine.join(u), i, q])
        return ravel_pytree((moved, after, law, [one[:kept] for one in commands]))[0], outputs

    scale = ravel_pytree((body_sizes, sizes.control, sizes.law, own.past(sizes.u)))[0]
    (F, G), (C, D) = jax.jacfwd(step, (0, 1))(x, jnp.zeros(own.machine.count, x.dtype))
    return StateSpace(F, G, C, D, scale, jnp.asarray(own.period) if own.sampled else None), A


def _body_rates(own: MachineAtSpeed, parts: tuple, u: Groups) -> Array:
    """Return the rates of rotor, plants, low-passes and amplifiers, `parts`, under commands u."""

    def lags(_: object, scenario: Scenario, seen: PlantOnly, z: Any, u_a: Any, u: Array) -> tuple[LagState, Array]:
        return LagState(seen.plant, z, u_a).lag_rates(scenario, u)

    q, q_dot, plant, filtered, voltage = parts
    seen = own.machine.moving(own.rotor.at_sensors, q, q_dot, tuple(map(PlantOnly, plant)))
    lagged = own.each(lags, seen, filtered, voltage, u)
    after = own.rates(q, q_dot, plant, tuple(applied for _, applied in lagged))
    z_rates, u_rates = (tuple(getattr(one, name) for one, _ in lagged) for name in ("z_filtered", "u_a"))
    return ravel_pytree((after.q, after.q_dot, plants_of(after.axes), z_rates, u_rates))[0]
