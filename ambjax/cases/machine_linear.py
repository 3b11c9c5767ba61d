"""Readers of linear controllers of a whole machine: from a file, and LQG."""

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ambjax.cases.named_files import controller_file
from ambjax.cases.reader import Case
from ambjax.cases.rotor_tables import MODES, RIGID
from ambjax.cases.speed_table import listed_speeds
from ambjax.cases.table import Table, show
from ambjax.control.current import AmplifierCurrent
from ambjax.control.linear_controller import OUTPUTS, SAME_PERIOD
from ambjax.control.lqg import DesignedController, LinearCoils, LqgWeights, RotorModel, design
from ambjax.control.machine_law import BOTH, CURRENTS, ERROR, StateSpaceLaw
from ambjax.control.realisation import several
from ambjax.world.rotation import PER_MINUTE
from ambjax.world.rotor import Rotor

# Largest number of speeds for which an LQG is designed.
MOST_DESIGNS = 50


def numbers(cases: Sequence[Case], name: str) -> np.ndarray:
    """Return a number of the nominal plant of every axis."""
    return np.array([float(getattr(case.cascade.model, name)) for case in cases])


def magnets(cases: Sequence[Case], voltage: bool) -> dict[str, Any]:
    """Return the numbers of the linear magnets of `StateSpaceLaw`. Raises ValueError if a resistance is 0."""
    kappa, s_0, i_0, m, g = (numbers(cases, name) for name in ("kappa", "s_0", "i_0", "m", "g"))
    R = numbers(cases, "R") if voltage else np.ones(len(cases))
    if not np.all(R > 0):
        raise ValueError("plant.R = 0: a controller with voltages as outputs needs a coil resistance above 0.")
    dv_di = 4 * i_0 / s_0**2
    found = {"dv_dz": 4 * i_0**2 / s_0**3, "dv_di": dv_di, "resting": m * g / (kappa / 4 * dv_di), "resistance": R}
    return {name: jnp.asarray(x) for name, x in found.items()}


def linear(top: Table, cases: list[Case], folder: pathlib.Path) -> StateSpaceLaw:
    """Return the controller of a file."""
    table, c = top.table("controller"), len(cases)
    table.only(["kind", "file", "output", "model", "current", "notch"])
    output = table.choice("output", list(OUTPUTS), OUTPUTS[0])
    if output == OUTPUTS[1] and any(case.scenario.drive == "current" for case in cases):
        raise ValueError(f'{table.at("output")} = "voltage": amplifiers with actuator.mode = "current" take currents.')
    convert = lambda A, B, C, D, dt=0.0: several((A, B, C, D), dt, c)  # noqa: E731
    matrices, steady, dt = controller_file(table, folder, convert).contents
    period = float(cases[0].clock.sample_period) if cases[0].cascade.sampled else None
    if dt and (period is None or not abs(period / dt - 1) < SAME_PERIOD):
        has = "in continuous time" if period is None else f"with a sample period of {period:g} s"
        why = f"the controller is discrete, dt = {dt:g} s, and this case runs {has}. Set [processor] and clock."
        raise table.refuse("file", f"{why}sample_period = {dt:g}, or give a continuous controller.")
    matrices = matrices if period is None else bilinear(matrices, period)
    n = len(matrices[0])
    return StateSpaceLaw(
        **{name: jnp.asarray(x)[None] for name, x in zip("ABCD", matrices, strict=True)},
        E=jnp.zeros((1, n, c)),
        a=jnp.zeros((1, n)),
        b=jnp.zeros((1, c)),
        steady=jnp.asarray(steady),
        start=jnp.zeros(n),
        sizes=jnp.full(n, float(numbers(cases, "s_0").min()) / 50),
        speeds=jnp.zeros(1),
        **magnets(cases, output == OUTPUTS[1]),
        inputs=ERROR if matrices[1].shape[1] == c else BOTH,
        output=output,
    )


def bilinear(matrices: tuple[np.ndarray, ...], period: float) -> tuple[np.ndarray, ...]:
    """Return the bilinear (Tustin) transform of a state space A, B, C, D. `period`: s."""
    A, B, C, D = matrices
    P = np.linalg.inv(np.eye(len(A)) - period / 2 * A)
    return 2 * P - np.eye(len(A)), period * P @ B, C @ P, D + period / 2 * C @ P @ B


class LqgProblem(NamedTuple):
    """The design of an LQG: models of the rotor at `speeds` (rpm), and linear magnets and coils.

    `weights`: the numbers of `LqgWeights`, none left out. `pole`: of the magnets, 1/s. `period`: sample period, s.
    `delay`: samples. `magnets`, `output`: fields of `StateSpaceLaw`.
    """

    weights: dict[str, float]
    speeds: list[float]
    models: list[RotorModel]
    coils: LinearCoils
    pole: float
    period: float
    delay: float
    magnets: dict[str, Any]
    output: str

    def law(self, weights: dict[str, float]) -> StateSpaceLaw:
        """Return the law with these weights. Raises ValueError if a Riccati equation has no solution."""
        found = [design(one, self.coils, weights, self.pole, self.period, self.delay) for one in self.models]
        first, names = found[0], [name for name in DesignedController._fields if name not in ("steady", "start")]
        return StateSpaceLaw(
            **{name: jnp.asarray(np.stack([getattr(one, name) for one in found])) for name in names},
            steady=jnp.asarray(first.steady), start=jnp.asarray(first.start), sizes=jnp.ones(len(first.a)),
            speeds=jnp.asarray(self.speeds), **self.magnets, inputs=CURRENTS, output=self.output,
        )  # fmt: skip


def lqg_problem(top: Table, cases: Sequence[Case], rotor: Rotor) -> LqgProblem:
    """Return the design of the LQG of a rotor."""
    table = top.table("controller")
    table.only(["kind", "model", "lqg", "notch"])
    own, cascade = table.table("lqg"), cases[0].cascade
    if not cascade.sampled:
        raise ValueError(f'{table.at("kind")} = "lqg": it is designed for a processor. Add [processor].')
    voltage = cases[0].scenario.drive == "voltage"
    given = own.record(LqgWeights, extra=("speeds", "modes"))
    known = (len(rotor.gravity) - RIGID) // 2
    count = own.leaf("modes", MODES, known)
    if count > known:
        raise ValueError(f"{own.at('modes')} = {count}: the rotor has {known} bending modes. Give at most as many.")
    coils, w = _coils(cases, voltage), float(numbers(cases, "pole").max())
    sizes = float(numbers(cases, "s_0").min()), float(numbers(cases, "i_0").min())
    force = float(np.max(coils.k_i * numbers(cases, "i_0")))
    usual = (sizes[0] / 400, sizes[1] / 10, sizes[0] / 2000, force, 0.03 * w * force)
    weights = {field.name: getattr(given, field.name) for field in dataclasses.fields(LqgWeights)}
    weights |= {name: x for name, x in zip(weights, usual, strict=False) if weights[name] is None}
    speeds = _speeds(own, float(rotor.speed))
    return LqgProblem(
        {name: float(x) for name, x in weights.items()}, speeds, [_model(rotor, cases, count, one) for one in speeds],
        coils, w, float(cases[0].clock.sample_period), float(cascade.timing.delay), magnets(cases, voltage),
        OUTPUTS[1 if voltage else 0],
    )  # fmt: skip


def lqg(top: Table, cases: list[Case], rotor: Rotor) -> StateSpaceLaw:
    """Return the LQG of a rotor."""
    problem = lqg_problem(top, cases, rotor)
    try:
        return problem.law(problem.weights)
    except ValueError as error:
        raise ValueError(f"controller.lqg: {error}. Change the weights, or the rotor's modes.") from None


def _speeds(table: Table, default: float) -> list[float]:
    speeds = listed_speeds(table, MOST_DESIGNS) if "speeds" in table.raw else [default]
    if sorted(speeds) != speeds:
        raise ValueError(f"{table.at('speeds')} = {show(speeds)}: the speeds must be in ascending order.")
    return speeds


def _coils(cases: Sequence[Case], voltage: bool) -> LinearCoils:
    """Return the linear magnets and coils at the current that carries the weight."""
    m, a, R, L, s_0 = (numbers(cases, name) for name in ("m", "a", "R", "L", "s_0"))
    models = [case.cascade.model for case in cases]
    i = np.array([float(model.equilibrium()[0]) for model in models])
    each = list(zip(models, i, strict=True))
    dv_dz = np.array([float(model.dv_dz(0.0, one)) for model, one in each])
    dv_di = np.array([float(model.dv_di(0.0, one)) for model, one in each])
    if voltage:
        return LinearCoils(m * a * dv_dz, m * a * dv_di, R, L, 2 * i / s_0)
    laws = [case.cascade.current for case in cases]
    lags = [1 / (2 * np.pi * float(law.bandwidth)) for law in laws if isinstance(law, AmplifierCurrent)]
    return LinearCoils(m * a * dv_dz, m * a * dv_di, np.ones(len(m)), np.array(lags), np.zeros(len(m)))


def _model(rotor: Rotor, cases: Sequence[Case], count: int, speed: float) -> RotorModel:
    """Return the model of the rotor with `count` bending modes at a speed, rpm."""
    B, C, M, D, K, G, gravity = (
        np.asarray(x, float)
        for x in (rotor.at_magnets, rotor.at_sensors, rotor.M, rotor.D, rotor.K, rotor.G, rotor.gravity)
    )
    kept = np.r_[np.flatnonzero(np.any(B[:, :RIGID] != 0, 0)), RIGID : RIGID + 2 * count]
    square, W = np.ix_(kept, kept), 2 * np.pi * PER_MINUTE * speed
    constant = gravity + B.T @ (numbers(cases, "m") * numbers(cases, "g"))
    return RotorModel(M[square], (D + W * G)[square], K[square], B[:, kept], C[:, kept], constant[kept])
