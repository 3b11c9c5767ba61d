"""Annotated case files, generated from the records of the code so that the two always agree."""

import dataclasses
import math
from typing import Any

from ambjax.cases.reader import KINDS, PLANTS, SIGNALS
from ambjax.cases.rig import RIG
from ambjax.ensemble.design import DESIGNS
from ambjax.paper.readings import PULSE, REFERENCE, TABLE_2
from ambjax.world.plant import Plant

# The templates: the paper's two scenarios, and a laboratory bearing.
SCENARIOS = ("tracking", "regulation", "rig")
HEAD = """\
# A case for ambjax: {title}.
# Units are SI. A key left out takes the value shown here unless its comment says otherwise.
# Check it with 'ambjax check', run it with 'ambjax simulate'.
"""

REST = """
[initial]                     # state at t = 0
z = 0.0                       # m; within the clearance
z_dot = 0.0                   # m/s
i = 0.0                       # A

[clock]
duration = 2.0                # s; a whole number of sample periods
sample_period = 1e-4          # s; period of the recorded rows, for which each measurement error is held
dt = "auto"                   # s, or "auto": method and step are chosen from the loop's slopes
# method = "rk4"              # with a number for dt: "rk4", "dop853", "euler", "rodas3" (L-stable) or "sliding", which
#                               is fast under noise where gamma p is large; with dt = "auto": "adaptive" or "sliding"

[run]
seed = 0                      # seed of all random numbers
settle = 0.5                  # s; time from which "settled" metrics count (left out: a quarter of the duration)
# clearance = 4.5e-3          # m; |z| at which the rotor touches down (left out: 0.9 s_0)

# [sensor]                    # Gaussian noise, held for a sample period, without delay (left out: none)
# std = {paper_std:.3e}          # m; this is the paper's, which its printed gains do not survive
# std_z_dot = 0.0             # m/s
# std_i = 0.0                 # A
# offset = 0.0                # m; offset of the position sensor
# gain = 1.0                  # 1; gain of the position sensor
# velocity = true             # whether z_dot is measured too; if false, an observer must estimate it
#                             # and with [processor]:
# bandwidth = 1e4             # Hz; first-order low-pass of the position sensor (left out: none)
# bits = 14                   # resolution of the converter of z and i (left out: not rounded)
# range_z = 5e-3              # m; the converter reads z from -range_z to range_z (left out: plant.s_0)
# range_i = 0.5               # A; the converter reads i from -range_i to range_i (left out: 2 plant.i_0)
#
# [sensor.outliers]           # faults of the position sensor, with [processor]: single readings (left out: none)
# rate = 1.0                  # 1/s; mean number of outliers per second
# size = 5e-3                 # m; error of an outlier, up or down
# at = 0.1                    # s; time of one more outlier (left out: none)
#
# [sensor.dropouts]           # stretches without a reading (left out: none)
# rate = 1.0                  # 1/s; mean number of dropouts per second
# duration = 5e-4             # s; duration of each dropout
# at = 0.1                    # s; time of one more dropout (left out: none)
# value = "hold"              # reading during a dropout: the last one ("hold"), "nan", "zero" or "full-scale"

# [processor]                 # the laws run on a processor, one step per sample (left out: in continuous time)
# delay = 1.0                 # samples from measurement to voltage, 0 to 2, fractions allowed
# discretisation = "implicit" # the sign is evaluated at the end of the step, and p = inf is allowed; or "explicit"
# predict = true              # the laws use the estimate predicted over the delay (left out: true if delay > 0)
# guard = {{}}                  # limits of the readings, below; false: every reading is accepted
#
# [processor.guard]           # a reading beyond a limit is replaced by a prediction (left out: derived from the case)
# z = 4.5e-3                  # m; largest |z| (left out: clearance times sensor gain, plus its offset and error)
# z_dot = 100.0               # m/s; largest |z_dot| (left out: two gaps per sample)
# i = 25.0                    # A; largest |i| (left out: 100 i_0)
# noise = 1.4e-5              # m; largest difference of two readings of one z (left out: from the sensor's errors)
# speed = 1e-3                # m/s; error of the predicted velocity (left out: from the sensor or the observer)
# samples = 18                # largest number of predictions in a row (left out: until an error grows e-fold)

# [actuator]
# u_max = 200.0               # V; limit of the supply (left out: none)
#                             # and with [processor]:
# bandwidth = 1e3             # Hz; bandwidth of the amplifier, first order (left out: no lag)
# slew = 1e7                  # V/s; largest rate of its voltage (left out: no limit)
# dead_band = 0.5             # V; subtracted from the size of its voltage (left out: none)
# i_max = 1.0                 # A; above it, the voltage does not increase |i| (left out: no limit)

# [spread]                    # what varies over an ensemble, by dotted path; 'ambjax simulate' ignores it
# design = "random"           # or {designs}
# plant.m = {{ percent = 10 }}  # uniform, +-10 % of the value above; the controller's model keeps that value
# plant.k_z = {{ percent = 10, shape = "normal" }}         # standard deviation 10 %, cut off at 6 standard deviations
# initial.z = {{ normal = 1e-4 }}                          # standard deviation, in m
# disturbance.q_z.amplitude = {{ log-uniform = [0.1, 2.0] }}
# disturbance.q_z.shift = {{ uniform = [-0.1, 0.1] }}      # s; start and stop of the pulse together
# actuator.u_max = {{ choices = [200, 500, 1000] }}        # V; equally likely

# [tune]                      # for 'ambjax tune', which starts at the gains above. Each key has its default here
# gains = ["controller.position.c", "controller.position.k"]  # gains to tune; left out: all gains of the laws but p
# bounds.controller.position.c = [1.0, 500.0]  # bounds of one gain; left out: from plant and theory, see the report; c
#                             # is then at most a fifth of the sample rate, others 3 times their range or start
# weights.tracking = 1.0      # each weight multiplies a dimensionless term: here the mean square error after run.settle
# weights.peak = 0.0          # largest error after run.settle
# weights.effort = 0.1        # mean square voltage
# weights.chatter = 0.1       # mean square step of the voltage
# weights.clearance = 1e-3    # closeness to the stop
# weights.survival = 1.0      # loss of the rotor, the earlier the more
# weights.conditions = 1.0    # conditions of Theorem 1 that fail, or hold by less than the margin
# limits.rms_u_V = 120.0      # V; root mean square voltage after run.settle, over members (left out: 60 % of u_max)
# limits.max_u_V = 150.0      # V; largest voltage of any member; inf, here and below: no limit (left out: none)
# limits.max_abs_i_A = 5.0    # A; largest current of any member (left out: none)
# limits.chatter_V_per_s = 1e5  # V/s; variation of the voltage after run.settle, mean over members (left out: none)
# limits.largest_error_m = 1e-5  # m; largest error after run.settle, of any member (left out: none)
# limits.settling_s = 0.2     # s; time of the run after which every error stays within the band (left out: none)
# limits.settling_band_m = 45e-6  # m; half-width of the settling band (left out: 1 % of the clearance)
# limits.overshoot_m = 1e-4   # m; how far z goes beyond its start and beyond the range of r so far (left out: none)
# limits.clearance_used = 0.8 # largest |z| of any member as a share of the clearance (left out: none)
# limits.survival = 1.0       # share of the held-out members that must survive
# limits.margin = 0.01        # share by which the search stays below a limit; left out: 0.005 of means, 0.03 of maxima
# conditions_margin = 0.1     # share by which each gain is to exceed its condition of Theorem 1
# early = 0.0                 # weight of errors before run.settle, relative to 1 after it
# risk = "cvar"               # how the members' losses are combined: "cvar", "soft-worst" or "mean"; left out: "mean"
# alpha = 0.9                 # for "cvar": the mean of the worst 1 - alpha; left out: 0.9
# members = 32                # members of the training ensemble, each with its own noise and [spread]
# stressed = 8                # further members that only have to survive, with more noise and with other gains
# stress = 1.2                # factor on the noise of the stressed members
# gain_margin = 1.25          # factor on each gain of the stressed members, up or down
# validation = 2000           # further members; those lost with the tuned gains join the stressed ones
# held_out = 1000             # further members, on which the tuned gains are judged
# seed = 1                    # seed of the members and of the screen; the other ensembles' seeds are far from it
# screen = 128                # points at which the search begins; 0: only at the gains above
# starts = 4                  # number of the best of these points, which are refined
# iterations = 40             # largest number of iterations in each phase of the refinement
# substeps = 3                # integration steps per sample
# optimiser = "bfgs"          # or one of optax, such as "adam"
# learning_rate = 0.1         # step size of an optimiser of optax
"""


def _lines(kind: type, values: Any) -> list[str]:
    lines = []
    for field in dataclasses.fields(kind):
        value = getattr(values, field.name)
        if value is None:
            continue
        unit = f"{field.metadata['unit']}; " if field.metadata["unit"] else ""
        lines.append(_with_note(f"{field.name} = {_number(value)}", unit + field.metadata["doc"]))
    return lines


def _law(kind: type) -> list[str]:
    """Return the lines of a law; a steepness p that scales with the plant becomes a comment."""
    law = kind()
    scaled, lines = law.size(Plant()) is not None, _lines(kind, law)
    return [
        line.replace("p =", "# p =").replace("  #", "#", 1) if scaled and line.startswith("p = ") else line
        for line in lines
    ]


def _others(kinds: dict[str, type]) -> str:
    return ", ".join(f'"{kind}"' for kind in list(kinds)[1:])


def _with_note(text: str, comment: str) -> str:
    return f"{text:<30}# {comment}"


def _number(value: float) -> str:
    text = repr(float(value)) if math.isfinite(value) else "inf"
    return text if "." in text or "e" in text or text == "inf" else text + ".0"


def template(scenario: str) -> str:
    """Return an annotated case file: the paper's "tracking" or "regulation" with repaired gains, or the "rig"."""
    if scenario == "rig":
        return RIG
    tracking = scenario == "tracking"
    lines = [HEAD.format(title=f"the paper's {scenario} scenario, Table 2 with gamma = 7.5e4")]
    kinds = _with_note('# kind = "lumped"', f"Eqs. (1), (2); or {_others(PLANTS)}: each coil's own current")
    lines += ["[plant]                       # the true plant, Table 1", kinds, *_lines(Plant, Plant()), ""]
    lines += [
        "[controller]",
        "model = {}                    # the controller's model, where it differs from the plant: { m = 0.6 }",
    ]
    for stage, kinds in KINDS.items():
        kind, law = next(iter(kinds.items()))
        lines += ["", f"[controller.{stage}]", _with_note(f'kind = "{kind}"', f"or {_others(kinds)}"), *_law(law)]
    lines += ["", _with_note("[reference]", f"in m: {', '.join(SIGNALS)}; left out: 0")]
    if tracking:
        lines += ['kind = "sine"', *_lines(type(REFERENCE), REFERENCE)]
    else:
        lines += ['kind = "constant"', "value = 0.0                   # m"]
    lines += ["", "[disturbance.q_z]             # likewise [disturbance.q_i], in A/s; left out: none"]
    lines += ['kind = "pulse"', _with_note('unit = "A^2/m^2"', 'scaled force; or "m/s^2", the default')]
    lines += _lines(type(PULSE), PULSE)
    designs = " or ".join(f'"{d}"' for d in list(DESIGNS)[1:])
    return "\n".join(lines) + "\n" + REST.format(paper_std=TABLE_2.noise_std, designs=designs)
