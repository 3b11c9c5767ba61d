"""The inputs of a case's loop, and the horizon within which two such loops can be compared despite rounding errors.

A closed loop with set-valued signs or converters amplifies rounding errors until two correct programs agree only in
their statistics. Twins of JAX's loop measure this growth. A twin is the loop that JAX simulates, with every state of
the plant and of the laws, and the command, changed at every sample by one unit in the last place, up or down at random.
While the twins stay close to JAX's loop, a correct program does too.
"""

import dataclasses
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.codegen.interface import LoopInputs
from ambjax.codegen.program import PRECISIONS
from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import Command
from ambjax.control.guard import Watch
from ambjax.numerics.gaussian import normals
from ambjax.numerics.records import Scalar, canonical, record, static
from ambjax.simulation.between import SampledState
from ambjax.simulation.clock import Clock
from ambjax.simulation.integrate import Advanced, Begin, Integrator
from ambjax.simulation.rollout import Extended, run
from ambjax.simulation.sampled import Sampled
from ambjax.simulation.system import sampled_of
from ambjax.simulation.trajectory import Row
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Errors
from ambjax.world.waveforms import Constant

T = TypeVar("T")

# TWINS: number of twins of each precision. PARTED: difference of a twin that ends the horizon, as a share of the rms of
# z - r or u (`Horizon.sizes`). LEAST: smallest number of samples for a verdict.
TWINS, PARTED, LEAST = 8, 1e-2, 20
# Signals that are compared. A large difference of a twin in any of them ends the horizon.
SIGNALS = ("z", "u")


def just_after(t: Scalar) -> Scalar:
    """Return the instant (s) at which the simulator evaluates signals for the sample at t: a jump at t has happened."""
    return t * (1 + 4 * float(jnp.finfo(jnp.result_type(float)).eps))


def series(cascade: Cascade, scenario: Scenario, clock: Clock, samples: int) -> dict[str, np.ndarray]:
    """Return the inputs of the loop at samples 0 to `samples` - 1, by name.

    The disturbances for sample n are those of the sample before, because these act until sample n.
    """
    given = sampled_of(cascade, scenario, clock)
    found = _series(canonical(given), jnp.arange(samples))
    return {name: np.asarray(x) for name, x in found._asdict().items()}


@jax.jit
def _series(system: Sampled, samples: Array) -> LoopInputs:
    loop = system.loop.realised()

    def one(n: Array) -> LoopInputs:
        t = just_after(n * system.period)
        before = just_after(jnp.maximum(n - 1, 0) * system.period)
        outside, w = loop.inputs(before), normals(loop.words(), n)
        return LoopInputs._make([outside.q_z, outside.q_i, *(w[k] for k in range(3)), *system.reference(t)])

    return jax.vmap(one)(samples)


class LoopCase(NamedTuple):
    """The loop to compare: a cascade on its processor, a scenario and a clock; `settle`: the settling time, s."""

    cascade: Cascade
    scenario: Scenario
    clock: Clock
    settle: float


class Horizon(NamedTuple):
    """JAX's loop, and the distance of the twins of one precision from it.

    `signals`: z (m) and u (V) of JAX's loop, [samples]. `parted`: the largest distance of any twin up to each sample,
    [samples]. `sizes`: the rms of z - r and of u in JAX's loop while the rotor is held, after the settling time (from
    the start, if the rotor is lost earlier). `samples`: number of samples before a twin
    differs by more than PARTED of a size, or the rotor is lost.
    """

    signals: dict[str, np.ndarray]
    parted: dict[str, np.ndarray]
    sizes: dict[str, float]
    samples: int

    @property
    def decisive(self) -> bool:
        return self.samples >= LEAST


class TwinState(NamedTuple):
    """State of a twin: that of its loop."""

    loop: SampledState


@record
class Twin(Extended):
    """The loop with every state changed at every sample. `seed` draws the signs.

    The change of a number is `unit` times its magnitude or its scale, whichever is larger.
    """

    loop: Sampled
    seed: Scalar = 0.0
    unit: Scalar = 0.0
    held: bool = static(default=False, doc="disturbances are constant over each sample")

    def start(self) -> TwinState:
        return TwinState(self.loop.start())

    def row(self, t: Scalar, state: TwinState, errors: Errors, alive: Array) -> Row:
        return self.loop.row(t, state.loop, errors, alive)

    def jump(self, t: Scalar, state: TwinState, errors: Errors) -> TwinState:
        """Change the states, compute the laws' step from them, and change the resulting command."""
        first, sample = state.loop, jnp.rint(t / self.loop.period).astype(jnp.int32)
        key = jax.random.fold_in(jax.random.key(jnp.asarray(self.seed, jnp.int32)), sample)
        before, after = jax.random.split(key)
        moved = self._moved(before, first, self._sizes(first))
        # flags, counters and the state of a faulty sensor are not changed
        watch = moved.watch._replace(left=first.watch.left) if first.watch else ()
        moved = moved._replace(finite=first.finite, watch=watch, started=first.started, sensed=first.sensed)
        stepped = self.loop.jump(t, moved, errors)
        return TwinState(stepped._replace(command=self._moved(after, stepped.command, self._sizes(stepped).command)))

    def advance(self, method: Integrator, errors: Errors, begin: Begin, period: Scalar) -> Advanced:
        begin = begin._replace(state=begin.state.loop)
        advanced = self._held if self.held else self.loop.advance
        after = advanced(method, errors, begin, period)
        return after._replace(state=TwinState(after.state))

    def _held(self, method: Integrator, errors: Errors, begin: Begin, period: Scalar) -> Advanced:
        loop, t = self.loop.loop, begin.t
        outside, none = loop.inputs(just_after(t)), loop.scenario.undisturbed()
        scenario = dataclasses.replace(none, q_z=Constant(outside.q_z), q_i=Constant(outside.q_i))
        # the exported plant has no time: t = 0 at the start of each sample
        held = Sampled(dataclasses.replace(loop, scenario=scenario), period, 0)
        after = held.advance(method, errors, begin._replace(t=jnp.zeros(())), period)
        return after._replace(t=t + after.t)

    def _moved(self, key: Array, state: T, sizes: T) -> T:
        """Return every number x changed by `unit` max(|x|, its scale), up or down."""
        leaves, tree = jax.tree.flatten(state)
        signs = jax.random.rademacher(key, (len(leaves),), float)
        steps = [jnp.maximum(jnp.abs(x), size) for x, size in zip(leaves, jax.tree.leaves(sizes), strict=True)]
        return jax.tree.unflatten(tree, [x + self.unit * s * h for x, s, h in zip(leaves, signs, steps, strict=True)])

    def _sizes(self, state: SampledState) -> SampledState:
        """Return the scale of each state.

        The scale of a voltage includes the voltage that changes the current by i_ref within one sample, because the
        laws divide the difference of two references by the period.
        """
        loop, period = self.loop.loop, self.loop.period
        cascade, plant, model = loop.cascade, loop.scenario.plant, loop.cascade.model
        i, v = jnp.asarray(model.i_0) / 25, jnp.asarray(model.v_size)
        gap = jnp.maximum(model.s_0 - jnp.abs(plant.measurement(state.plant).z), 0.01 * model.s_0)
        driven = model.L * model.s_0 / gap * jnp.maximum(jnp.abs(state.command.i_ref), i) / period
        volt = i if cascade.current.commands == "current" else jnp.abs(model.R * model.i_0) + driven
        return SampledState(
            plant=plant.scale(),
            control=cascade.scale(),
            command=Command(i_ref=i, i_ref_dot=i * model.pole, u=volt, v_star=v, v_tilde=v),
            past=(volt,) * len(state.past),
            finite=jnp.zeros(()),
            z_filtered=jax.tree.map(lambda _: plant.s_0 / 50, state.z_filtered),
            u_a=jax.tree.map(lambda _: volt, state.u_a),
            watch=state.watch and Watch(plant.sizes(), jnp.zeros(())),
            started=state.started,
            sensed=state.sensed,
        )


def horizons(case: LoopCase, precisions: list[str], *, held: bool = False) -> dict[str, Horizon]:
    """Simulate JAX's loop and its twins. Return the horizon of each precision."""
    given = sampled_of(case.cascade, case.scenario, case.clock)
    twin, clock = canonical((Twin(given, held=held), case.clock))
    units = [0.0] + [float(np.finfo(PRECISIONS[x]).eps) for x in precisions for _ in range(TWINS)]
    signals, r, lost_at = _together(twin, clock, jnp.asarray(units), jnp.arange(len(units)))
    z_and_u = {name: np.asarray(x) for name, x in zip(SIGNALS, signals, strict=True)}
    period = float(clock.sample_period)
    alive = int(np.clip(np.ceil(float(lost_at[0]) / period), 0, clock.samples))
    settled = slice(round(case.settle / period) if case.settle < period * alive else 0, max(alive, 1))
    plain = {name: x[0] for name, x in z_and_u.items()}
    errors = {**plain, "z": plain["z"] - np.asarray(r[0])}
    sizes = {name: float(np.sqrt(np.mean(x[settled] ** 2))) for name, x in errors.items()}
    found = {}
    for k, precision in enumerate(precisions):
        lanes = slice(1 + k * TWINS, 1 + (k + 1) * TWINS)
        parted = {name: farthest(x[lanes], x[0]) for name, x in z_and_u.items()}
        far = [np.flatnonzero(~(x <= PARTED * sizes[name])) for name, x in parted.items()]
        ends = [int(beyond[0]) for beyond in far if beyond.size]
        found[precision] = Horizon(plain, parted, sizes, min([alive, *ends]))
    return found


def farthest(loops: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the largest distance of any loop [loops, samples] from the reference up to each sample, [samples]."""
    return np.maximum.accumulate(np.abs(loops - reference).max(axis=0))


@jax.jit
def _together(twin: Twin, clock: Clock, units: Array, seeds: Array) -> tuple[tuple[Array, ...], Array, Scalar]:
    """Return z and u of one loop for each unit and seed, [loops, samples]; r, same shape; time of each loss, s."""

    def one(unit: Array, seed: Array) -> tuple[tuple[Array, ...], Array, Scalar]:
        system = dataclasses.replace(twin, unit=unit, seed=seed)
        made = run(system, clock, None, record_every=1).trajectory
        return tuple(getattr(made.rows, name) for name in SIGNALS), made.rows.r, made.lost_at

    return jax.vmap(one)(units, seeds)
