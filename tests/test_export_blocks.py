"""The plant and the loop as blocks: their steps are the simulator's, and what cannot be exported is refused."""

import dataclasses
import tomllib

from ambjax import Clock
from ambjax.cases.reader import case_from
from ambjax.cases.template_text import template
from ambjax.world.amplifier import Amplifier
from ambjax.world.coils import TwoCoil


def rig(**more):
    """The laboratory's bearing: Kalman filter, hard signs, low-pass, converter, a limit of the current."""
    case = case_from(tomllib.loads(template("rig")))
    scenario = dataclasses.replace(case.scenario, **more)
    return case.cascade, scenario, Clock(400, case.clock.sample_period)


CASES = {
    "rig": rig(),
    "two coils": rig(
        plant=TwoCoil(**{f.name: getattr(rig()[1].plant, f.name) for f in dataclasses.fields(TwoCoil)}),
        amplifier=Amplifier(bandwidth=5e3, slew=2e6, dead_band=0.1),
    ),
}
