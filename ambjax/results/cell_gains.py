"""The controllers of the cells of a map: default gains for their numbers, and gains of their notches."""

import dataclasses

import numpy as np

from ambjax.cases.controller_tables import with_gains_of_notch
from ambjax.cases.machine_case import AnyCase
from ambjax.cases.reader import Case, cascade_at
from ambjax.ensemble.distributions import Uniform
from ambjax.ensemble.maps import PERIOD
from ambjax.ensemble.paths import places
from ambjax.ensemble.spread import Spread, apply
from ambjax.ensemble.study import AnyStudy, Study
from ambjax.linear.analysis import linearisation_inputs
from ambjax.linear.notch_design import redesigned_at_once, redesigned_members
from ambjax.results.machine_study import MachineStudy

# First words of the numbers for which default gains are designed.
OF_DESIGN = ("controller.model.", "processor.", PERIOD)
# First words of the numbers of a controller, for which its notch is designed. Other numbers are those of its machine.
GAINS, DESIGNED = ".notch.gains.", (".controller.", ".processor.", f".{PERIOD}")


def gains_of_cells(case: AnyCase, study: AnyStudy, axes: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the numbers of the controllers of cells, by dotted path, that follow from the axes.

    `axes`: the values [N] of the axes by dotted path.
    """
    values = default_gains(case, study, axes) if isinstance(case, Case) else {}  # a machine is read again (`rereads`)
    return values | notch_gains(study, axes | values)


def default_gains(case: Case, study: AnyStudy, axes: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the default gains [N] of a case that the file has with the numbers of these cells, by dotted path.

    A gain with another value than in the file of the case was set in Python, and stays. Raises ValueError if the file
    has no default there.
    """
    own = {path: x for path, x in axes.items() if path.startswith(OF_DESIGN)}
    if not own or not case.text:
        return {}
    usual = _numbers(case, float(case.clock.sample_period), {})
    designs, cell = np.unique(np.stack(list(own.values()), 1), axis=0, return_inverse=True)
    period, found = float(study.clock.sample_period), []
    for design in designs.tolist():
        values = dict(zip(own, design, strict=True))
        try:
            found.append(_numbers(case, values.pop(PERIOD, period), values))
        except ValueError as error:
            raise ValueError(f"{', '.join(f'{path}={x:g}' for path, x in values.items())}: {error}") from None
    same = {path for path, place in study.places().items() if path in usual and place.value == usual[path]}
    rows = {path: [one.get(path) for one in found] for path in same - set(axes)}
    changed = {path: x for path, x in rows.items() if None not in (usual[path], *x) and x != [usual[path]] * len(x)}
    return {path: np.array(x)[cell.ravel()] for path, x in changed.items()}


def _numbers(case: Case, period: float, changes: dict[str, float]) -> dict[str, float | None]:
    """Return the numbers of the controller that the file of a case gives with these changes, by dotted path."""
    known = places(cascade_at(case, period, changes), case.scenario)
    return {path: place.value for path, place in known.items() if path.startswith(("controller.", "processor."))}


def with_speeds_for(study: Study, axes: dict[str, np.ndarray]) -> Study:
    """Return the study of one axis with gains of its notch for all speeds of these values by dotted path."""
    turning = {path: Uniform(float(x.min()), float(x.max())) for path, x in axes.items() if path.startswith("rotor.")}
    if not turning:
        return study
    others = [entry for entry in study.spread.entries if entry[0] not in turning]
    wide = Spread((*others, *turning.items()))
    cascade = with_gains_of_notch(study.cascade, study.scenario, study.clock, wide)
    return dataclasses.replace(study, cascade=cascade)


def notch_gains(study: AnyStudy, axes: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the gains of the notches of a study, designed for the nominal case with the controllers of cells.

    `axes`: the values [N] of the axes by dotted path. Gains that an axis gives itself stay. The notch of a cell without
    a linearisation is off: its gains are 0.
    """
    own = {path: x for path, x in axes.items() if any(part in f".{path}" for part in DESIGNED)}
    if not own or any(GAINS in path for path in own) or not any(GAINS in path for path in study.places()):
        return {}
    designs, cell = np.unique(np.stack(list(own.values()), 1), axis=0, return_inverse=True)
    values = {path: x for path, x in zip(own, designs.T, strict=True) if path != PERIOD}
    if isinstance(study, MachineStudy):
        each = [study.notch_gains({path: float(x[k]) for path, x in values.items()}) for k in range(len(designs))]
        found = {path: np.array([one[path] for one in each]) for path in each[0]}
    else:
        assert isinstance(study, Study)
        found = _of_axis(study, values)
    return {path: np.nan_to_num(x)[cell.ravel()] for path, x in found.items()}


def _of_axis(study: Study, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the gains [N] of the notch of one axis with these values [N], by dotted path; [1] without values."""
    loop = *apply(study.cascade, study.scenario, values), study.clock
    gains = redesigned_members(*loop) if values else redesigned_at_once(*linearisation_inputs(*loop))
    return {
        f"controller.notch.gains.{k}.{name}": np.atleast_1d(np.asarray(getattr(gain, name)))
        for k, gain in enumerate(gains) for name in ("real", "imaginary")
    }  # fmt: skip
