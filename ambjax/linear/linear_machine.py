"""Linearisation of a whole machine at rest and constant speed: all loops are closed, each axis has a test signal."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import CascadeState, Sample
from ambjax.control.machine_law import MachineInputs
from ambjax.linear.analysis import Zones
from ambjax.linear.equilibrium import TOLERANCE, at_rest, ideal, inverse, newton_of, reading, sizes_of, start_of
from ambjax.linear.margins import NO_PEAK, Margins, ResponsePeak, peak, poles_in_s, reading_margins, whole_end
from ambjax.linear.state_space import StateSpace
from ambjax.numerics.records import Scalar, canonical
from ambjax.numerics.small_matrices import exponential, times
from ambjax.numerics.smooth import TWO_PI
from ambjax.simulation.joint_laws import forces, inputs_of
from ambjax.simulation.whole_machine import Machine, MachineState, PlantOnly, SampledMachine, still
from ambjax.world.rotation import PER_MINUTE
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Measurement

T = TypeVar("T")
# Parts of a point or of its rates: one stacked pytree for each group.
Groups = tuple


class AxisSensitivity(NamedTuple):
    """Peaks of an axis: of |S_kk| with its zone, of |T_kk| (1), and of |KS_kk| (V/m, or A/m for a current command).

    `margins`: of the loop broken at the reading of this axis, with the others closed; None if the machine is unstable.
    """

    name: str
    S: ResponsePeak
    T: ResponsePeak
    KS: ResponsePeak
    zone: str
    margins: Margins | None


class MachineSensitivity(NamedTuple):
    """Sensitivity of a machine at one speed, with all loops closed.

    - `speed`: rpm. `stable`: whether no mode grows. If one does, the peaks are infinite, and the zones D.
    - `axes`: the peaks of each axis. `sigma`: peak of the largest singular value of the matrix S.
    - `poles`: poles of the machine, 1/s, in the order of decreasing real part.
    - `system`: the linear system, with inputs e_k at the sensors, and outputs as of `linearise_machine`.
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


class MachineRest(NamedTuple):
    """A point of the machine at rest: coordinates [n]; plants, laws and commands [c_g] of each group.

    `law`: state of the law of the machine, () without one.
    """

    q: Array
    plant: Groups
    control: Groups
    u: Groups
    law: object = ()


class _Linear:
    """The machine at constant speed without what a linear system cannot contain (`ideal`), with test signals e [c]."""

    def __init__(self, machine: Machine, W: Scalar, period: Scalar):
        self.machine, self.W, self.period = machine.realised(), W, period
        loops = self.machine.loops()
        self.scenario = tuple(jax.vmap(ideal)(loop.scenario) for loop in loops)
        speed = W / (TWO_PI * PER_MINUTE)
        laws = [jax.vmap(lambda cascade: cascade.at_speed(speed))(loop.cascade) for loop in loops]
        self.cascade = tuple(cascade.with_processor(guard=None) for cascade in laws)
        self.rotor = self.machine.rotor
        self.low_passed = [one.sensors.bandwidth is not None for one in self.scenario]
        self.lagged = [one.actuator.slow for one in self.scenario]

    @property
    def sampled(self) -> bool:
        """Whether the laws run on a processor."""
        return isinstance(self.machine, SampledMachine)

    def each(self, function: Callable[..., T], *groups: Sequence[object]) -> list[T]:
        """Return function(cascade, scenario, ...) of every axis, stacked for each group."""
        return [jax.vmap(function)(*own) for own in zip(self.cascade, self.scenario, *groups, strict=True)]

    def start(self) -> tuple[MachineRest, MachineRest]:
        """Return the machine at q = 0, where each axis carries its share of the weight, and the sizes of the states."""
        points = self.each(lambda cascade, scenario: start_of(cascade, scenario, self.period, 0.0))
        sizes = self.each(lambda cascade, scenario, point: sizes_of(cascade, scenario, point), points)
        q = jnp.zeros_like(jnp.asarray(self.rotor.gravity))
        size = self.machine.scale(sizes)
        first = MachineRest(q, *_parts(points))
        if self.machine.law is not None:
            e = tuple(jnp.zeros_like(u) for u in first.u)
            measured = self.read(q, jnp.zeros_like(q), first.plant, self.sensed(q), e)
            law = self.machine.law.begin(self.machine.join(measured), self.inputs(self.past(first.u)))
            first = first._replace(law=jax.tree.map(lambda x: jnp.asarray(x, q.dtype), law))
        return first, jax.tree.map(
            lambda x, s: jnp.zeros_like(x) + s, first, MachineRest(size.q, *_parts(sizes), size.law)
        )

    def read(
        self, q: Array, q_dot: Array, plant: Groups, z: Sequence[object], e: Sequence[object]
    ) -> list[Measurement]:
        """Return the readings of the groups. `z`: outputs of the low-passes, or () without."""
        states = self.machine.moving(self.rotor.at_sensors, q, q_dot, tuple(map(PlantOnly, plant)))

        def one(_: object, scenario: Scenario, own: PlantOnly, z: Array | tuple[()], e: Array) -> Measurement:
            motion = scenario.plant.measurement(own.plant)
            return reading(scenario, motion if isinstance(z, tuple) else motion._replace(z=z), (e, 0.0))

        return self.each(one, states, z, e)

    def rates(self, q: Array, q_dot: Array, plant: Groups, u: Groups) -> MachineState:
        """Return the rates of (q, q_dot, plant) under voltages or commanded currents u."""
        states = self.machine.moving(self.rotor.at_magnets, q, q_dot, tuple(map(PlantOnly, plant)))

        def one(_: object, scenario: Scenario, own: PlantOnly, u: Array) -> PlantOnly:
            return PlantOnly(scenario.plant.rates(own.plant, scenario.coil_voltage(u, own.plant)))

        moved = self.each(one, states, u)
        return self.machine.coupled((jnp.asarray(self.rotor.gravity), self.W), MachineState(q, q_dot, ()), moved)

    def inputs(self, past: Sequence[Any]) -> MachineInputs:
        """Return the inputs of the law of the machine. `past`: commands on their way, of the groups."""
        count = self.machine.count
        reference = jax.tree.map(lambda x: jnp.zeros(count) + x, at_rest(0.0))
        return inputs_of(
            self.machine, reference, self.W, jnp.full(count, jnp.inf), self.machine.join(past), self.period
        )

    def laws(
        self, measured: Sequence[Measurement], control: Groups, law: object, past: Sequence[Any]
    ) -> tuple[Groups, Groups, object]:
        """Return the commands of the groups, and the next states of the laws, or their rates in continuous time."""
        reference, unlimited, count = at_rest(0.0), jnp.asarray(jnp.inf), len(self.cascade)
        demands: Groups = ((None, None),) * count
        notched: Groups = (None,) * count

        def sample(past: tuple) -> Sample:
            return Sample(reference, self.period, unlimited, past)

        def notch(cascade: Cascade, _: object, read: Measurement, state: CascadeState, past: tuple) -> tuple:
            return cascade.observed(read, state.observer, reference, sample(past) if self.sampled else None)

        whole = self.machine.law
        if whole is not None:
            act = whole.step if self.sampled else whole
            parts = self.each(notch, measured, control, past)
            demanded, law = act(self.machine.join([one for one, _ in parts]), law, self.inputs(past))
            demands, notched = forces(self.machine, demanded), tuple(after for _, after in parts)

        def one(
            cascade: Cascade, _: object, measured: Measurement, control: CascadeState, past: tuple, *demand: Any
        ) -> tuple[Array, CascadeState]:
            (force, estimate), own = demand
            if force is not None:
                if self.sampled:
                    command, after = cascade.commanded(force, estimate, control, sample(past))
                else:
                    command, after = cascade.command_rates(force, estimate, control, reference, unlimited)
                after = after._replace(observer=own)
            elif self.sampled:
                command, after, _ = cascade.step(measured, control, sample(past))
            else:
                command, after = cascade(measured, control, reference, unlimited)
            return command.u, after

        found = self.each(one, measured, control, past, demands, notched)
        return tuple(u for u, _ in found), tuple(after for _, after in found), law

    def past(self, u: Groups) -> Groups:
        """Return the commands on their way under constant commands u; () in continuous time."""
        pasts = (one.timing.constant_past(own) for one, own in zip(self.cascade, u, strict=True))
        return tuple(past if self.sampled else () for past in pasts)

    def sensed(self, q: Array) -> Groups:
        """Return the displacements at the sensors, for the groups with a low-pass."""
        z = self.machine.split(times(self.rotor.at_sensors, q))
        return tuple(own if on else () for own, on in zip(z, self.low_passed, strict=True))

    def residual(self, point: MachineRest) -> MachineRest:
        """Return what is 0 at an equilibrium, in the units of the states."""
        zero, e = jnp.zeros_like(point.q), tuple(jnp.zeros_like(u) for u in point.u)
        moved = self.rates(point.q, zero, point.plant, point.u)
        poles = [scenario.plant.pole for scenario in self.scenario]
        measured = self.read(point.q, zero, point.plant, self.sensed(point.q), e)
        u, after, law = self.laws(measured, point.control, point.law, self.past(point.u))
        fastest = jnp.max(self.machine.join(poles))
        if self.sampled:
            change = jax.tree.map(lambda a, b: b - a, point.control, after)
            law = jax.tree.map(lambda a, b: b - a, point.law, law)
        else:
            change = tuple(jax.tree.map(lambda x, w=w: x / w, own) for own, w in zip(after, poles, strict=True))
            law = jax.tree.map(lambda x: x / fastest, law)
        axes = zip(moved.axes, poles, strict=True)
        plant = tuple(jax.tree.map(lambda x, w=w: x / w, own.plant) for own, w in axes)
        return MachineRest(moved.q_dot / fastest**2, plant, change, jax.tree.map(jnp.subtract, u, point.u), law)

    def rest(self, held: "_Linear") -> MachineRest:
        """Return the equilibrium, or the point nearest to it that was found.

        `held`: the same machine, without derivatives.
        """
        start, sizes = held.start()
        scale, (flat, restore) = ravel_pytree(sizes)[0], ravel_pytree(start)
        newton = newton_of(lambda y: held.deviation(restore(y * scale), scale), flat / scale)
        found = newton.error <= TOLERANCE * jnp.finfo(flat.dtype).eps
        # one more step with a constant Jacobian, as in `equilibrium`
        step = inverse(newton.J) @ self.deviation(restore(newton.y * scale), scale)
        return restore((newton.y - jnp.where(found, step, 0.0)) * scale)

    def deviation(self, point: MachineRest, scale: Array) -> Array:
        """Return the residual relative to the sizes of the states."""
        return ravel_pytree(self.residual(point))[0] / scale

    def system(self, point: MachineRest) -> tuple[StateSpace, Array, Array]:
        """Return the state space at a point, its A under constant commands, and whether the machine rests there."""
        sizes = self.start()[1]
        deviation = self.deviation(point, ravel_pytree(sizes)[0])
        found = jnp.max(jnp.abs(deviation)) <= TOLERANCE * jnp.finfo(deviation.dtype).eps
        amplified = tuple(u if on else () for u, on in zip(point.u, self.lagged, strict=True))
        body, restore = ravel_pytree((point.q, jnp.zeros_like(point.q), point.plant, self.sensed(point.q), amplified))
        fastest = jnp.max(self.machine.join([scenario.plant.pole for scenario in self.scenario]))
        low = self.machine.split(times(jnp.abs(self.rotor.at_sensors), sizes.q))
        lag_sizes = tuple(x if on else () for x, on in zip(low, self.low_passed, strict=True))
        u_sizes = tuple(x if on else () for x, on in zip(sizes.u, self.lagged, strict=True))
        body_sizes = ravel_pytree((sizes.q, sizes.q * fastest, sizes.plant, lag_sizes, u_sizes))[0]

        def moved(x: Array, u: Groups) -> Array:
            q, q_dot, plant, filtered, own = restore(x)
            z_rates, u_rates, applied = [], [], []
            for k, (scenario, z) in enumerate(zip(self.scenario, self.sensed(q), strict=True)):
                bandwidth, amplifier = scenario.sensors.bandwidth, scenario.actuator
                low = () if bandwidth is None else 2 * jnp.pi * jnp.asarray(bandwidth)
                z_rates.append(() if isinstance(low, tuple) else low * (z - filtered[k]))
                slow = self.lagged[k]
                u_rates.append(jnp.asarray(amplifier.slope()) * (u[k] - own[k]) if slow else ())
                applied.append(own[k] if slow else u[k])
            after = self.rates(q, q_dot, plant, tuple(applied))
            return ravel_pytree((after.q, after.q_dot, _plants(after.axes), tuple(z_rates), tuple(u_rates)))[0]

        def read(x: Array, e: Array) -> list[Measurement]:
            q, q_dot, plant, filtered, _ = restore(x)
            return self.read(q, q_dot, plant, filtered, self.machine.split(e))

        u = self.machine.join(point.u)
        free = jax.jacfwd(lambda x, u: moved(x, self.machine.split(u)), (0, 1))(body, u)
        if self.sampled:
            ((A, B), (C, D)), scale = self._sampled(point, sizes, body, body_sizes, free, read)
        else:
            ((A, B), (C, D)), scale = self._continuous(point, sizes, body, body_sizes, moved, read)
        return StateSpace(A, B, C, D, scale, jnp.asarray(self.period) if self.sampled else None), free[0], found

    def outputs(self, measured: Sequence[Measurement], u: Groups, x: Array) -> Array:
        """Return the outputs of the linear system: readings, commands, and currents of the axes, and coordinates."""
        z, i = (self.machine.join([getattr(one, name) for one in measured]) for name in ("z", "i"))
        return jnp.concatenate([z, self.machine.join(u), i, x[: len(jnp.asarray(self.rotor.gravity))]])

    def _continuous(
        self, point: MachineRest, sizes: MachineRest, body: Array, body_sizes: Array, moved: Callable, read: Callable
    ) -> tuple:
        x, restore = ravel_pytree((body, point.control, point.law))

        def field(x: Array, e: Array) -> tuple[Array, Array]:
            at, control, law = restore(x)
            measured = read(at, e)
            u, *rates = self.laws(measured, control, law, self.past(point.u))
            return ravel_pytree((moved(at, u), tuple(rates)))[0], self.outputs(measured, u, at)

        scale = ravel_pytree((body_sizes, sizes.control, sizes.law))[0]
        return jax.jacfwd(field, (0, 1))(x, jnp.zeros(self.machine.count, x.dtype)), scale

    def _sampled(
        self,
        point: MachineRest,
        sizes: MachineRest,
        body: Array,
        body_sizes: Array,
        free: tuple[Array, Array],
        read: Callable,
    ) -> tuple:
        past, delay = self.past(point.u), jnp.asarray(self.cascade[0].timing.delay)[0]
        (A, B), kept = free, len(past[0])
        transition, driven = _held(A, B, self.period, delay, kept)
        x, restore = ravel_pytree((body, point.control, point.law, past))

        def step(x: Array, e: Array) -> tuple[Array, Array]:
            at, control, law, past = restore(x)
            measured = read(at, e)
            u, after, law = self.laws(measured, control, law, past)
            commands = [self.machine.join([(own, *old)[lag] for own, old in zip(u, past, strict=True)])
                        for lag in range(kept + 1)]  # fmt: skip
            end = transition @ at + sum(effect @ one for effect, one in zip(driven, commands, strict=True))
            kept_now = tuple((own, *old)[:kept] for own, old in zip(u, past, strict=True))
            return ravel_pytree((end, after, law, kept_now))[0], self.outputs(measured, u, at)

        scale = ravel_pytree((body_sizes, sizes.control, sizes.law, self.past(sizes.u)))[0]
        return jax.jacfwd(step, (0, 1))(x, jnp.zeros(self.machine.count, x.dtype)), scale


def _plants(axes: Sequence) -> Groups:
    return tuple(own.plant for own in axes)


def _parts(points: Sequence) -> tuple[Groups, Groups, Groups]:
    """Return the plants without motion, the laws and the commands of the groups' points."""
    return _plants(still(points)), tuple(one.control for one in points), tuple(one.u for one in points)


def _held(A: Array, B: Array, period: Scalar, delay: Scalar, kept: int) -> tuple[Array, list[Array]]:
    """Return the map of one sample [N, N], and the effects [N, c] of the command of each sample, the newest first.

    The command of a sample acts from `delay` samples after it until one sample later.
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
def _at_rest(machine: Machine, W: Scalar, period: Scalar) -> MachineRest:
    return _Linear(machine, W, period).rest(_Linear(jax.lax.stop_gradient(machine), W, period))


@jax.jit
def _matrices(machine: Machine, W: Scalar, period: Scalar, point: MachineRest) -> tuple[StateSpace, Array, Array]:
    return _Linear(machine, W, period).system(point)


def machine_rest(machine: Machine, period: Scalar) -> MachineRest:
    """Return the equilibrium of a machine at speed 0, or the point nearest to it that was found."""
    return _at_rest(machine, 0.0, period)


def machine_loop(machine: Machine, W: Scalar, period: Scalar, point: MachineRest) -> StateSpace:
    """Return the linear system of `linearise_machine` at the speed W (rad/s) and at a known equilibrium.

    It works under jit, vmap and differentiation. States that no input reaches are not left out.
    """
    return _Linear(machine, W, period).system(point)[0]


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
        system, free, rests = found
        if not rests:
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
    """Return the sensitivity of a machine at a constant speed (rpm). Raises ValueError as `linearise_machine` does.

    `names`: of the axes. `period`: sample period, s. `zones`: frequency range and limits.
    """
    return sensitivity_of(next(turning_machines(machine, period, [speed])), names, speed, zones)


def sensitivity_of(point: TurningMachine, names: tuple[str, ...], speed: float, zones: Zones) -> MachineSensitivity:
    """Return the sensitivity of a linear machine. `speed`: rpm. The others as for `machine_sensitivity`."""
    system, c = point.system.without_idle(), len(names)
    end = whole_end(system)
    low, high = zones.range(None if system.period is None else float(system.period), max(end, 2 * float(zones.f_low)))
    stable = system.stable

    responses: dict[bytes, np.ndarray] = {}

    def response(f: np.ndarray) -> np.ndarray:
        """Return the response at frequencies f (Hz). All peaks scan the same frequencies."""
        key = np.asarray(f).tobytes()
        if key not in responses:
            responses[key] = np.asarray(system.response(f))
        return responses[key]

    def largest(magnitude: Callable) -> ResponsePeak:
        if not stable:
            return NO_PEAK
        return peak(system, lambda f: magnitude(response(f)), low, high, end)

    axes = []
    for k, name in enumerate(names):
        S = largest(lambda H, k=k: np.abs(H[:, k, k]))
        T = largest(lambda H, k=k: np.abs(H[:, k, k] - 1))
        KS = largest(lambda H, k=k: np.abs(H[:, c + k, k]))
        own = system._replace(B=system.B[:, [k]], C=system.C[[k]], D=system.D[[k]][:, [k]])
        margins = reading_margins(own) if stable else None
        axes.append(AxisSensitivity(name, S, T, KS, zones.zone(S.height), margins))
    sigma = largest(lambda H: np.linalg.norm(H[:, :c], 2, axis=(1, 2)))
    poles = poles_in_s(system)
    return MachineSensitivity(speed, stable, tuple(axes), sigma, poles[np.argsort(-np.real(poles))], system)
