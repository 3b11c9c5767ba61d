"""The closed loop of a case, in continuous time or on a processor."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.compiler.short_compilation import compiled_quickest
from ambjax.control.base import set_valued_signs
from ambjax.control.cascade import Cascade
from ambjax.control.cascade_state import CascadeState, Sample
from ambjax.control.law_trial import check_own_law
from ambjax.control.stages import STAGES
from ambjax.numerics.declared import require_number
from ambjax.numerics.records import Scalar, canonical, is_traced, validate
from ambjax.simulation.clock import Clock
from ambjax.simulation.folds import Named
from ambjax.simulation.loop import ClosedLoop
from ambjax.simulation.sampled import Sampled
from ambjax.world.scenario import Scenario
from ambjax.world.waveforms import Reference


def check_inputs(cascade: Cascade, scenario: Scenario, clock: Clock) -> None:
    """Raise ValueError for an invalid value that is not traced. The message gives its path and a correction."""
    for name, value, kind in (("cascade", cascade, Cascade), ("scenario", scenario, Scenario), ("clock", clock, Clock)):
        if not isinstance(value, kind):
            raise ValueError(f"{name} = {type(value).__name__}: it must be a {kind.__name__}.")
    _check_stages(cascade)
    for name, value in (("cascade", cascade), ("scenario", scenario), ("clock", clock)):
        require_records(name, value)
    for stage in STAGES:
        check_own_law(getattr(cascade, stage), stage, cascade.model)
    validate(dataclasses.replace(cascade, processor=None), "controller")
    validate(cascade.processor, "processor")
    check_parts(cascade, scenario, clock.sample_period)
    validate(scenario, "scenario")
    validate(clock, "clock")
    require_number("clock.samples", clock.samples, 1, whole=True)
    require_number("clock.method.substeps", getattr(clock.method, "substeps", 1), 1, whole=True)


def _check_stages(cascade: Cascade) -> None:
    for stage, base in STAGES.items():
        law = getattr(cascade, stage)
        if not isinstance(law, base):
            name = f"the class {law.__name__}" if isinstance(law, type) else type(law).__name__
            derive = f"Derive the class from ambjax.extend.{base.__name__}"
            fix = f"Write {law.__name__}()" if isinstance(law, type) else derive
            raise ValueError(f"controller.{stage} = {name}: it is not a law of this stage. {fix}.")


def require_records(name: str, node: Any) -> None:
    """Raise ValueError if a part of the record `node` is a number, a text, a class or a function."""
    for field in dataclasses.fields(node):
        value, usual = getattr(node, field.name), field.default
        if not (field.metadata.get("leaf") or field.metadata.get("static")) and (
            isinstance(value, (list, dict)) or jax.tree_util.all_leaves([value])
        ):
            like = f", such as {type(usual).__name__}()" if dataclasses.is_dataclass(usual) else ""
            raise ValueError(f"{name}.{field.name} = {value!r}: it must be a record{like}.")


def check_recording(fold: object, record_every: object) -> None:
    """Raise ValueError for arguments of `rollout` that are not a fold, or not a number of samples."""
    if fold is not None:
        _check_fold("fold", fold)
    require_number("record_every", record_every, 0, whole=True)


def _check_fold(path: str, fold: object) -> None:
    complete = all(hasattr(fold, method) for method in ("init", "update", "result"))
    if isinstance(fold, type) or jax.tree_util.all_leaves([fold]) or not complete:
        raise ValueError(
            f"{path} = {fold!r}: it must be a fold, such as ambjax.Metrics.for_case(case) or a record with the methods "
            "of ambjax.extend.Fold, or None."
        )
    if isinstance(fold, Named):
        if not isinstance(fold.folds, Mapping):
            raise ValueError(f"{path}.folds = {fold.folds!r}: it must be a dict of folds by name.")
        for name, one in fold.folds.items():
            _check_fold(f"{path}.{name}", one)


def check_parts(cascade: Cascade, scenario: Scenario, sample_period: Scalar) -> None:
    """Raise ValueError, with the path and the fix, for parts of a loop that are not compatible. `sample_period`: s."""
    _check_stages(cascade)
    _check_laws(cascade, sample_period)
    if not cascade.sampled:
        _check_smooth(cascade)
        if (path := scenario.on_processor) is not None:
            raise ValueError(
                f"{path} is for a controller on a processor, and this one runs in continuous time. Add [processor], or "
                f"leave out {path}."
            )
    if cascade.current.commands != scenario.drive:
        raise ValueError(
            f'actuator.mode = "{scenario.drive}": controller.current = {type(cascade.current).__name__} commands a '
            f"{cascade.current.commands}. Leave out [controller.current] to get a law that commands a "
            f"{scenario.drive}, or change the mode."
        )
    _check_coils(scenario)
    if not scenario.sensors.velocity and reads_velocity(cascade, sample_period):
        raise ValueError(
            "sensor.velocity = false: the velocity is not measured, controller.observer does not estimate it, and the "
            'laws or the prediction use it. Choose an observer that estimates it, for example kind = "kalman", or laws '
            "that do not use it, with processor.predict = false."
        )


def _check_smooth(cascade: Cascade) -> None:
    """Raise ValueError for a law with a steepness of inf: in continuous time a sign must be smoothed."""
    for stage, law in zip(CascadeState._fields, cascade.laws, strict=True):
        for name in set_valued_signs(law):
            raise ValueError(
                f"controller.{stage}.{name} = inf: in continuous time a sign must be smoothed. Give a finite number, "
                "or add [processor], which allows the set-valued sign."
            )


def reads_velocity(cascade: Cascade, period: Scalar) -> bool:
    """Return whether the command or a state of a law depends on the measured velocity.

    `period`: sample period, s. True if a number is traced, because the laws are then not evaluated. Otherwise the laws
    of the first member are evaluated at three velocities, and the results compared.
    """
    if cascade.observer.estimates_velocity or cascade.timing.predicts:
        return not cascade.observer.estimates_velocity
    if any(map(is_traced, jax.tree.leaves((cascade, period)))):
        return True
    one = cascade.on_processor() if cascade.sampled else cascade
    one, period = jax.tree.map(lambda x: np.ravel(np.asarray(x, float))[0], (one, period))
    results = (_stepped(*canonical((one, period, size))) for size in (-1e3, 1.0, 1e3))
    return len({tuple(map(float, jax.tree.leaves(result))) for result in results}) > 1


@compiled_quickest
def _stepped(cascade: Cascade, period: Array, size: Array) -> tuple[Array, CascadeState]:
    """Return the command and the states of the laws after one step. `size`: reading of the velocity, as a multiple."""
    sizes, zero = cascade.model.sizes(), jnp.zeros(())
    past = cascade.timing.constant_past(zero)
    sample = Sample(Reference(zero, zero, zero), period if cascade.sampled else None, jnp.inf, past)
    state = cascade.init(sizes._replace(z_dot=zero), sample.reference)
    command, after, _ = cascade.step(sizes._replace(z_dot=size * sizes.z_dot), state, sample)
    return command.u, after


def _check_coils(scenario: Scenario) -> None:
    """Raise ValueError for limits of each coil if both coils have one current, or if |i| is limited too."""
    amplifier = scenario.actuator
    if amplifier.coil is None:
        return
    if not scenario.plant.two_voltages:
        raise ValueError(
            f"actuator.coil: {type(scenario.plant).__name__} has one current for both coils, so a coil has no limit of "
            'its own. Use plant.kind = "two-coil".'
        )
    if amplifier.i_max is not None:
        raise ValueError(
            "actuator.i_max: it limits half the difference of the currents, and actuator.coil limits each current. "
            "Leave i_max out, and give actuator.coil.i_max = plant.i_0 + i_max instead."
        )


def _check_laws(cascade: Cascade, sample_period: Scalar) -> None:
    """Raise ValueError for a law that does not fit the model, the sample period, or the demand of the position law."""
    known = cascade.sampled and not is_traced(sample_period)
    period = float(np.max(np.asarray(sample_period))) if known else None
    for stage, law in zip(CascadeState._fields, cascade.laws, strict=True):
        try:
            if known or not cascade.sampled:
                law.check_use(cascade.model, period)
        except ValueError as error:
            raise ValueError(f"controller.{stage}: {error}") from None
    demand = cascade.position.demand
    for stage, law in (("inversion", cascade.inversion), ("current", cascade.current)):
        if demand not in law.accepts:
            raise ValueError(
                f"controller.{stage} = {type(law).__name__}: it does not take the {demand} that "
                f"{type(cascade.position).__name__} demands. Leave out [controller.{stage}] to get a law that takes it."
            )


def started(cascade: Cascade, scenario: Scenario) -> Scenario:
    """Return the scenario. If a traced delay is none that the program supports, z is NaN at t = 0, and thus afterwards.

    Otherwise the rollout would use another delay, because the program is fixed before the value is known.
    """
    timing = cascade.timing
    if not (is_traced(timing.delay) or is_traced(timing.assumed)):
        return scenario
    z = jnp.where(timing.supported(whole=True), scenario.initial.z, jnp.nan)
    return dataclasses.replace(scenario, initial=dataclasses.replace(scenario.initial, z=z))


def system_of(cascade: Cascade, scenario: Scenario, clock: Clock) -> ClosedLoop | Sampled:
    """Return the closed loop of the cascade, in continuous time or on its processor."""
    if cascade.sampled:
        return sampled_of(cascade, scenario, clock)
    return ClosedLoop(cascade, scenario, cuts=clock.cuts or 0)


def sampled_of(cascade: Cascade, scenario: Scenario, clock: Clock) -> Sampled:
    """Return the closed loop of a cascade on its processor."""
    period = clock.sample_period
    return Sampled(ClosedLoop(simulated(cascade.on_processor(), scenario, period), scenario), period, clock.cuts)


def guarded(cascade: Cascade, scenario: Scenario, period: Scalar) -> Cascade:
    """Return the cascade with the numbers of its guard set for a scenario; unchanged if it has no guard."""
    guard = cascade.timing.guard
    if guard is None:
        return cascade
    guard = guard.with_limits(cascade.model, scenario, period, ClosedLoop(cascade, scenario).measures_velocity)
    return cascade.with_processor(guard=guard)


def simulated(cascade: Cascade, scenario: Scenario, period: Scalar) -> Cascade:
    """Return the cascade for a simulation.

    If all limits of its guard are derived and the sensor has no faults, the guard would refuse no reading, and it is
    removed. Otherwise the numbers of the guard are set (`guarded`).
    """
    guard = cascade.timing.guard
    if guard is not None and guard.derived and not scenario.sensors.faulty:
        return cascade.with_processor(guard=None)
    return guarded(cascade, scenario, period)
