"""Software in the loop: JAX's plant under the compiled C, beside JAX's plant under JAX's controller."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.control.cascade import Command
from ambjax.export.controller import BITS, OUTPUTS
from ambjax.export.machine import Compiled
from ambjax.export.statements import PRECISIONS
from ambjax.numerics.records import Scalar, canonical, record, static
from ambjax.simulation.clock import Clock
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.metrics import Standard
from ambjax.simulation.rollout import run
from ambjax.simulation.sampled import Sampled, SampledState, system_of
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Measurement
from ambjax.world.signals import Reference

FAULTS = [1 << k for k, name in enumerate(BITS) if name in ("refused", "failed")]


class Kept(NamedTuple):
    """What the C keeps, and how often it refused an input or a law gave no number."""

    numbers: Array
    started: Array
    faults: Array


class Machines:
    """Compiled controllers as one function of numbers: which of them, what it keeps, what it reads."""

    def __init__(self, *machines: Compiled):
        self.machines = machines
        self.room = max(machine.state["numbers"].size for machine in machines)

    def step(self, which: Any, numbers: Any, started: Any, inputs: Any) -> tuple[np.ndarray, np.ndarray]:
        """Numbers kept, and started, bits and outputs."""
        machine = self.machines[int(which)]
        count = machine.state["numbers"].size
        machine.state["numbers"], machine.state["started"] = np.asarray(numbers)[:count], int(started)
        machine.inputs[:] = np.asarray(inputs)
        bits = machine.step()
        kept = np.zeros(self.room)
        kept[:count] = machine.state["numbers"]
        return kept, np.array([float(machine.state["started"]), float(bits), *machine.outputs], float)


@record
class Looped(Sampled):
    """The sampled loop with its laws in C: `which` of the machines."""

    which: Scalar
    machines: Machines = static()

    def realised(self) -> "Looped":
        return dataclasses.replace(self, loop=self.loop.realised())

    def start(self) -> SampledState:
        zero = jnp.zeros(())
        return super().start()._replace(control=Kept(jnp.zeros(self.machines.room), zero, zero))

    def decided(self, measured: Measurement, reference: Reference, state: SampledState) -> SampledState:
        kept: Any = state.control
        inputs = jnp.stack([*measured, *reference])
        shapes = jax.ShapeDtypeStruct((self.machines.room,), float), jax.ShapeDtypeStruct((2 + len(OUTPUTS),), float)
        numbers, rest = jax.pure_callback(
            self.machines.step, shapes, self.which, kept.numbers, kept.started, inputs, vmap_method="sequential"
        )
        answer = dict(zip(OUTPUTS, rest[2:], strict=True))
        command = Command(**answer, i_ref_dot=jnp.zeros(()))
        faulty = rest[1].astype(int) & sum(FAULTS) != 0
        after: Any = Kept(numbers, rest[0], kept.faults + faulty)
        past, sane = (state.command.u, state.past[0]), jnp.where(faulty, 0.0, state.sane)
        return state._replace(control=after, command=command, past=past, sane=sane)


class Loop(NamedTuple):
    """One closed loop: displacement (m) over time, and every metric."""

    z: np.ndarray
    metrics: dict[str, float]


class Beside(NamedTuple):
    """A loop beside that of JAX: largest |dz| (m), and the metric that is off most; each with what is allowed.

    `own`: how far JAX's own loop goes from itself where the rotor starts some rounding units of the gap off, m.
    """

    dz: float
    allowed: float
    own: float
    metric: str
    off: float
    off_allowed: float


# What is allowed of dz as a share of the gap, and of a metric, beside TIMES what rounding does to JAX's own loop.
BARS = {"double": (1e-9, 1e-9), "float": (1e-5, 1e-2)}
# And rounding units of what the quantity amounts to, for a metric that is near 0.
TIMES, ROUNDINGS = 10.0, 100.0
# Rounding units of the gap by which JAX's own loop is begun off: more than one, for a converter may not see one.
NUDGES = (1, -2, 5)
run_jit = jax.jit(run, static_argnames=("every",))


class Case(NamedTuple):
    """What is looped: a cascade on its processor in a scenario, over a clock, measured."""

    cascade: Any
    scenario: Scenario
    clock: Clock
    fold: Standard


def beside(case: Case, machines: dict[str, Compiled]) -> dict[str, Beside]:
    """The case under each compiled controller, by precision, beside the case under JAX's."""
    given: Any = system_of(case.cascade, case.scenario, case.clock)
    host, found = Machines(*machines.values()), {}
    reference = _loop(given, case)
    for which, precision in enumerate(machines):
        looped = _loop(Looped(ClosedLoop(given.loop.cascade, case.scenario), given.period, which, host), case)
        own = [_loop(system_of(case.cascade, nudged, case.clock), case) for nudged in _nudged(case.scenario, precision)]
        found[precision] = _compared(reference, own, looped, precision, case)
    return found


def _nudged(scenario: Scenario, precision: str) -> list[Scenario]:
    """The scenario with the rotor begun some rounding units of the gap off."""
    unit = float(scenario.plant.s_0) * float(np.finfo(PRECISIONS[precision]).eps)
    starts = [dataclasses.replace(scenario.initial, z=scenario.initial.z + n * unit) for n in NUDGES]
    return [dataclasses.replace(scenario, initial=start) for start in starts]


def _compared(reference: Loop, own: list[Loop], looped: Loop, precision: str, case: Case) -> Beside:
    """A loop beside JAX's. Where rounding alone moves that, every quantity may be off by that share of a gap."""
    plant, period = case.scenario.plant, float(case.clock.sample_period)
    gap_share, share = BARS[precision]
    dz, *moved = (float(np.abs(x.z - reference.z).max()) for x in (looped, *own))
    shaken = TIMES * max(moved) / float(plant.s_0)
    rounding = ROUNDINGS * float(np.finfo(PRECISIONS[precision]).eps) + shaken
    off, allowed = {}, {}
    for name, should in reference.metrics.items():
        size = abs(should) if np.isfinite(should) else 0.0
        free = period if _is_time(name) else rounding * _amount(name, plant)
        allowed[name] = (share + shaken) * size + TIMES * max(_off(x.metrics[name], should) for x in own) + free
        off[name] = _off(looped.metrics[name], should)
    worst = max(off, key=lambda name: _share(off[name], allowed[name]))
    return Beside(dz, (gap_share + shaken) * float(plant.s_0), max(moved), worst, off[worst], allowed[worst])


def _share(off: float, allowed: float) -> float:
    """How much of what is allowed something is off: above 1 or inf fails, and so does what is no number."""
    if off <= allowed:
        return off / allowed if 0 < allowed < np.inf else 0.0
    return off / allowed if allowed > 0 and np.isfinite(off) else np.inf


def _is_time(name: str) -> bool:
    """Whether a metric is a time, s, and not a rate."""
    return name.endswith("_s") and not name.endswith("_per_s")


def _amount(name: str, plant: Any) -> float:
    """What a metric's quantity amounts to, by its unit: a metric near 0 is what rounding left of that."""
    sizes = {"_A2_per_m2": plant.v_size, "_m_per_s": plant.sigma_size, "_m": plant.s_0, "_A": plant.i_0}
    return next((float(size) for unit, size in sizes.items() if name.endswith(unit)), 0.0)


def _off(a: float, b: float) -> float:
    return 0.0 if a == b else abs(a - b)


def _loop(system: Any, case: Case) -> Loop:
    system, clock, fold = canonical((system, case.clock, case.fold))
    outcome = run_jit(system, clock, fold, every=1)
    return Loop(np.asarray(outcome.trajectory.rows.z), {k: float(v) for k, v in outcome.measured.items()})
