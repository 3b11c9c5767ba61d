"""The evidence for the claims: all runs of one reading from which the ledger computes its verdicts."""

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ambjax import paper
from ambjax.compiler.fast_path import one_kernel
from ambjax.control.cascade import Cascade
from ambjax.numerics.records import canonical
from ambjax.simulation.clock import Clock
from ambjax.simulation.method import with_method
from ambjax.simulation.metrics import Metrics
from ambjax.simulation.rollout import rollout
from ambjax.simulation.rosenbrock import AdaptiveRodas3
from ambjax.simulation.sliding import Slide
from ambjax.simulation.trajectory import Trajectory
from ambjax.theorem.conditions import Report, check
from ambjax.world.plant import Plant
from ambjax.world.scenario import Initial, Scenario
from ambjax.world.sensor import Sensor

# The noise scan: standard deviations, from 10 nm to the paper's 0.316 mm, m; sample periods in continuous time, s;
# samples of a run; seeds for each std and period. On a processor, the only sample period is that of the clock.
NOISE_STDS = np.logspace(-8, -3.5, 10)
NOISE_PERIODS = (1e-5, 1e-4, 1e-3)
NOISE_SAMPLES = 3000
SEEDS = 2
# Initial |z| of the basin scan, m.
BASIN = np.logspace(-7, -3, 10)
# The plant's parameters that are varied, one at a time.
UNCERTAIN = ("m", "k_z", "R", "A")
# Fixed steps for a reading of the paper whose noise is constant over each sample. They cost half as much as adaptive
# steps; z differs by at most 4e-9 m (tested).
STEPS = {"tuned": Slide(16)}


class Run(NamedTuple):
    """One rollout: its trajectory, its metrics as floats, and the trajectory without the pulse (None: not computed)."""

    trajectory: Trajectory
    metrics: dict[str, float]
    quiet: Any = None


class Survival(NamedTuple):
    """Result of a scan of ascending values.

    `upto`: the largest value up to which every member survives; 0 if there is none. `undecided`: the next value, if no
    member is lost there but the integrator stalled; None if a member is lost there, or if every member survives all
    values.
    """

    upto: float
    undecided: float | None


def survival_of(tried: np.ndarray, lost: np.ndarray, stalled: np.ndarray) -> Survival:
    """Return the survival of a scan over the ascending values `tried` [N]."""
    ended = np.flatnonzero(lost | stalled)
    first = int(ended[0]) if ended.size else len(tried)
    unknown = bool(ended.size) and not lost[first]
    return Survival(float(tried[first - 1]) if first else 0.0, float(tried[first]) if unknown else None)


class Noise(NamedTuple):
    """The noise scan at one sample period (s).

    `survived`, `undecided`: `Survival` over NOISE_STDS, m. `sigma`: for each of these, the mean over the seeds of the
    largest settled |sigma|, m/s.
    """

    sample_period: float
    horizon: float
    survived: float
    undecided: float | None
    sigma: np.ndarray

    def std_for(self, radius: float) -> float | None:
        """Return the std, m, at which the largest settled |sigma| equals `radius`, m/s. None: not within the scan.

        The std is interpolated linearly on logarithmic scales, between the stds up to which every member survives.
        """
        count = int(np.sum(self.survived >= NOISE_STDS))
        if count < 2 or not self.sigma[0] <= radius <= self.sigma[count - 1]:
            return None
        logs = np.interp(np.log(radius), np.log(self.sigma[:count]), np.log(NOISE_STDS[:count]))
        return float(np.exp(logs))


class Uncertain(NamedTuple):
    """Tracking with one parameter of the plant changed: lost cases, stalled cases, and the largest settled error, m.

    The largest error includes that of lost cases, whose state is frozen.
    """

    lost: list[str]
    stalled: list[str]
    error: float


class Evidence(NamedTuple):
    """All runs and checks of one reading."""

    regulation: Run
    tracking: Run
    on_processor: dict[bool, Run]
    """tracking on the processor of `sampled`, under noise (True); for readings without noise also without it (False)"""
    check_regulation: Report
    check_tracking: Report
    noise: list[Noise]
    basin: Survival
    """|z(0)| in m up to which the rotor is held after a start at rest with the equilibrium currents for z = 0"""
    uncertain: Uncertain


def gather(reading: str, say: Callable[[str], None] = lambda text: None) -> Evidence:
    """Run all simulations and checks of a reading and return the evidence. `say` receives the name of each stage."""
    cascade = paper.cascade(reading)
    runs, checks = {}, {}
    with ThreadPoolExecutor() as pool:  # compilation and compiled programs release the GIL
        say(f"{reading}: noise")
        periods = (float(paper.CLOCK.sample_period),) if cascade.sampled else NOISE_PERIODS
        first = pool.submit(_noise, cascade, reading, periods[0])
        for name in ("regulation", "tracking"):
            say(f"{reading}: theorem, {name}")
            check_clock = paper.CLOCK.with_method(AdaptiveRodas3())
            checking = pool.submit(check, cascade, paper.scenario(name, reading), check_clock)
            say(f"{reading}: {name}")
            quiet = _simulate(reading, cascade, paper.scenario(name, reading, pulse=False)).trajectory
            runs[name] = _simulate(reading, cascade, paper.scenario(name, reading))._replace(quiet=quiet)
            checks[name] = checking.result()
        say(f"{reading}: on a processor")
        on_processor = {True: runs["tracking"]} if cascade.sampled else _on_processor(reading)
        # The first scan compiled the program that these reuse.
        noise = [first.result(), *pool.map(lambda period: _noise(cascade, reading, period), periods[1:])]
    say(f"{reading}: basin of attraction")
    basin = _basin(cascade, reading)
    say(f"{reading}: uncertain plant")
    uncertain = _uncertain(cascade, reading)
    reports = checks["regulation"], checks["tracking"]
    return Evidence(runs["regulation"], runs["tracking"], on_processor, *reports, noise, basin, uncertain)


def _simulate(reading: str, cascade: Cascade, scenario: Scenario) -> Run:
    if scenario.sensor is None:  # a sensor without error, so that the program is the same as under noise
        scenario = dataclasses.replace(scenario, sensor=Sensor())
    clock = paper.CLOCK
    if not cascade.sampled:
        clock = clock.with_method(STEPS.get(reading, AdaptiveRodas3()))
    trajectory, metrics = rollout(cascade, scenario, clock, fold=Metrics(paper.SETTLE))
    return Run(jax.tree.map(np.asarray, trajectory), {name: float(value) for name, value in metrics.items()})


def _on_processor(reading: str) -> dict[bool, Run]:
    scenario, cascade = paper.scenario("tracking", reading), paper.on_processor(reading)
    quiet = {} if reading in paper.NOISY else {False: _simulate(reading, cascade, scenario)}
    return quiet | {True: _simulate(reading, cascade, paper.noisy(scenario))}


def _uncertain(cascade: Cascade, reading: str) -> Uncertain:
    """Simulate tracking with one parameter of the plant at a time 10 % larger or smaller than in the model."""
    cases = [(name, factor) for name in UNCERTAIN for factor in (0.9, 1.1)]

    def one(case: tuple[str, float]) -> dict[str, float]:
        name, factor = case
        plant = dataclasses.replace(Plant(), **{name: getattr(Plant(), name) * factor})
        scenario = dataclasses.replace(paper.scenario("tracking", reading), plant=plant)
        return _simulate(reading, cascade, scenario).metrics

    with ThreadPoolExecutor() as pool:
        metrics = list(pool.map(one, cases))
    named = [(f"{name} {100 * (factor - 1):+.0f} %", m) for (name, factor), m in zip(cases, metrics, strict=True)]
    lost, stalled = ([name for name, m in named if m[status]] for status in ("lost", "stalled"))
    return Uncertain(lost, stalled, max(m["settled_max_abs_error_m"] for m in metrics))


@one_kernel
def _scan(cascade: Cascade, scenarios: Scenario, clock: Clock) -> dict[str, np.ndarray]:
    fold = Metrics(0.4 * clock.duration)
    return jax.lax.map(lambda s: rollout(cascade, s, clock, fold=fold, record_every=0).metrics, scenarios)


def _batch(one: object, size: int, **leaves: object) -> Any:
    """Return an ensemble of `size` copies of a scenario or of a part of one; `leaves` replace fields."""
    copies = jax.tree.map(lambda x: jnp.broadcast_to(x, (size,)), canonical(one))
    return dataclasses.replace(copies, **leaves)


def _scanned(cascade: Cascade, scenarios: Scenario, period: float) -> tuple[Cascade, Scenario, Clock]:
    if cascade.sampled:
        return cascade.on_processor(), scenarios, with_method(Clock(NOISE_SAMPLES, period), cascade, scenarios)
    # With this tolerance sigma's radius differs from that at 1e-6 by at most 1 % at all noise levels, at half the cost.
    return cascade, scenarios, Clock(NOISE_SAMPLES, period, AdaptiveRodas3(1e-4))


def _noise(cascade: Cascade, reading: str, period: float) -> Noise:
    """Scan regulation without the pulse over the noise levels at one sample period, s."""
    stds, seeds = np.repeat(NOISE_STDS, SEEDS), np.tile(np.arange(SEEDS), len(NOISE_STDS))
    quiet, size = paper.scenario("regulation", reading, pulse=False), len(stds)
    sensors = _batch(Sensor(), size, std=jnp.asarray(stds))
    scenarios = _batch(quiet, size, sensor=sensors, seed=jnp.asarray(seeds, int))
    metrics = _scan(*canonical(_scanned(cascade, scenarios, period)))
    lost, stalled = (np.any(np.reshape(metrics[status], (-1, SEEDS)), axis=1) for status in ("lost", "stalled"))
    sigma = np.asarray(metrics["settled_max_abs_sigma_m_per_s"]).reshape(-1, SEEDS).mean(axis=1)
    return Noise(period, NOISE_SAMPLES * period, *survival_of(NOISE_STDS, lost, stalled), sigma)


def _basin(cascade: Cascade, reading: str) -> Survival:
    """Scan undisturbed regulation over z(0), from rest, with i = i_ref at the equilibrium for z = 0."""
    offsets = np.concatenate([BASIN, -BASIN])
    size, plant = len(offsets), Plant()
    current = float(plant.equilibrium(0.0)[0])
    start = dataclasses.replace(cascade, inversion=dataclasses.replace(cascade.inversion, i_ref=current))  # pyright: ignore
    zeros = jnp.zeros(size)
    quiet = paper.scenario("regulation", reading, pulse=False)
    initial = Initial(jnp.asarray(offsets), zeros, zeros + current)
    scenarios = _batch(dataclasses.replace(quiet, sensor=Sensor()), size, initial=initial)
    metrics = _scan(*canonical(_scanned(start, scenarios, float(paper.CLOCK.sample_period))))
    ended = [np.reshape(metrics[status], (2, -1)) for status in ("lost", "stalled")]
    return survival_of(BASIN, *(either[0] | either[1] for either in ended))
