"""Annotated case files. Numbers of the plant, the laws, the signals and [tune] come from the code's records."""

import dataclasses
import math

from ambjax.cases import tune_table
from ambjax.cases.controller_tables import KINDS
from ambjax.cases.data_sheet import BEARING, RIG
from ambjax.cases.machine_templates import FLEXIBLE, MACHINE
from ambjax.cases.reader import PLANTS
from ambjax.cases.scenario_tables import SIGNALS
from ambjax.cases.ufu_template import UFU
from ambjax.ensemble.design import DESIGNS
from ambjax.paper.readings import PULSE, REFERENCE, TABLE_2
from ambjax.world.plant import Plant

# Templates of bearings other than the paper's, and of whole machines, by name.
MACHINES = {"rig": RIG, "bearing": BEARING, "machine": MACHINE, "machine-flexible": FLEXIBLE, "machine-ufu": UFU}
HEAD = """\
# A case for ambjax: {title}.
# Units are SI. A key that is left out has the value shown here, unless its comment says otherwise.
# Check it with 'ambjax check', run it with 'ambjax simulate'.
"""

REST = """
[initial]                     # state at t = 0
z = 0.0                       # m; within the clearance
z_dot = 0.0                   # m/s
i = 0.0                       # A

[clock]
duration = 2.0                # s; a whole number of sample periods
sample_period = 1e-4          # s; period of the recorded rows, of the held measurement errors and of [processor]
dt = "auto"                   # s, or "auto": method and step are chosen from the loop's slopes
# method = "rk4"              # with a number for dt: "rk4", "dop853", "euler", "rodas3" (L-stable) or "sliding" (fast
#                               under noise if gamma p is large); with dt = "auto": "adaptive" or "sliding"

[run]
seed = 0                      # seed of all random numbers
settle = 0.5                  # s; time from which "settled" metrics count (left out: a quarter of the duration)
# clearance = 4.5e-3          # m; |z| at which the rotor touches down (left out: 0.9 s_0)
# stop_stiffness = 1e7        # N/m; touchdown bearing at the clearance (left out: a rotor that touches down is lost)
# stop_damping = 500.0        # N s/m; damping of the touchdown bearing (left out: 0)

# [sensor]                    # Gaussian noise, held for a sample period, without delay (left out: none)
# std = {paper_std:.3e}          # m; the paper's value, with which its printed gains lose the rotor (left out: 0)
# std_z_dot = 0.0             # m/s
# std_i = 0.0                 # A
# offset = 0.0                # m; offset of the position sensor
# gain = 1.0                  # 1; gain of the position sensor
# velocity = true             # whether z_dot is measured too; if false, an observer must estimate it
#                             # the next keys require [processor]:
# bandwidth = 1e4             # Hz; first-order low-pass of the position sensor (left out: none)
# bits = 14                   # resolution of the converter of z and i (left out: not rounded)
# range_z = 5e-3              # m; the converter reads z from -range_z to range_z (left out: plant.s_0)
# range_i = 0.5               # A; the converter reads i from -range_i to range_i (left out: 2 plant.i_0)
#
# [sensor.outliers]           # faults of the position sensor, with [processor]: single readings (left out: none)
# rate = 1.0                  # 1/s; mean number of outliers per second (left out: 0)
# size = 5e-3                 # m; error of an outlier, of either sign (left out: 1e-3)
# at = 0.1                    # s; time of an additional outlier (left out: none)
#
# [sensor.dropouts]           # intervals without a reading (left out: none)
# rate = 1.0                  # 1/s; mean number of dropouts per second (left out: 0)
# duration = 5e-4             # s; duration of each dropout
# at = 0.1                    # s; time of an additional dropout (left out: none)
# value = "hold"              # reading during a dropout: the last one ("hold"), "nan", "zero" or "full-scale"

# [rotor]                     # speed of everything that turns: unbalance, runout, notch (left out: nothing turns)
# speed = 6000.0              # rpm; speed at t = 0
# acceleration = 3000.0       # rpm/s; rate of the speed (left out: 0)
# speed_end = 12000.0         # rpm; speed at which a run-up or run-down ends (left out: it never ends)

# [controller.notch]          # notch at the speed of [rotor] (left out: no notch)
# kind = "force-free"         # removes this speed from the current, or, with "displacement-free", from z
# rate = 10.0                 # 1/s; rate at which the notch converges
# min_speed = 3000.0          # rpm; speed from which the notch is on (left out: 0)
# max_speed = 9000.0          # rpm; speed above which the notch is off again (left out: no limit)
# phase = 30.0                # degrees; phase of the response that it inverts (left out: that of the linear loop)

# [sensor.runout]             # runout of the surface that the position sensor reads, with [rotor] (left out: none)
# harmonics = [{{ number = 1, amplitude = 1e-6, phase = 0.0 }}]  # waves per turn, m, rad

# [processor]                 # the laws run on a processor, one step per sample (left out: in continuous time)
# delay = 1.0                 # samples from measurement to voltage, 0 to 2, fractions allowed
# discretisation = "implicit" # the sign is evaluated at the end of the step, and p = inf is allowed; or "explicit"
# predict = true              # the laws use the estimate predicted over the delay (left out: true if delay > 0)
# guard = {{}}                  # limits of the readings, below; false: every reading is accepted
#
# [processor.guard]           # a reading beyond a limit is replaced by a prediction (left out: derived from the case)
# z = 4.5e-3                  # m; largest |z| (left out: clearance times sensor gain, plus sensor offset and error)
# z_dot = 100.0               # m/s; largest |z_dot| (left out: two gaps per sample)
# i = 25.0                    # A; largest |i| (left out: 100 i_0)
# noise = 1.4e-5              # m; largest difference of two readings of one z (left out: from the sensor's errors)
# speed = 1e-3                # m/s; largest error of the predicted velocity (left out: from the sensor or the observer)
# samples = 18                # largest number of successive predictions (left out: until an error grows by a factor e)

# [actuator]
# mode = "voltage"            # the controller commands a voltage; or "current", with bandwidth and i_max only
# u_max = 200.0               # V; limit of the supply (left out: none)
#                             # keys for [processor] or mode = "current" (then bandwidth is that of the current loop):
# bandwidth = 1e3             # Hz; bandwidth of the amplifier, first order (left out: no lag)
# slew = 1e7                  # V/s; largest rate of its voltage (left out: no limit)
# dead_band = 0.5             # V; subtracted from the absolute value of its voltage (left out: none)
# i_max = 1.0                 # A; above it, the voltage does not increase |i|; bounds a commanded i (left out: none)
#
# [actuator.coil]             # limits of each coil, for plant.kind = "two-coil" and [processor] (left out: none)
# u_max = 200.0               # V; limit of the |voltage| of a coil, R i_0 included (left out: no limit)
# i_max = 0.5                 # A; above it, the voltage does not increase the current of a coil (left out: no limit)
# unidirectional = true       # the current of a coil cannot become negative (left out: false)

# [sensitivity]               # range and zones of 'ambjax sensitivity' (ISO 14839, from secondary sources)
# f_low = 1.0                 # Hz; lowest frequency; 0 is always included
# f_high = 2e3                # Hz; highest (left out: 0.45 of the sampling rate)
# amplitude = 5e-5            # m; of the multi-sine of an injection (left out: 1 % of the gap)
# zone_a = 3.0                # upper limit of zone A for the peak of |S|
# zone_b = 4.0                # upper limit of zone B
# zone_c = 5.0                # upper limit of zone C; above it is zone D
# clearance_a = 0.3           # upper limit of zone A for the largest |z|, as a share of the clearance
# clearance_b = 0.4           # upper limit of zone B
# clearance_c = 0.5           # upper limit of zone C; above it is zone D

# [spread]                    # distributions of numbers over an ensemble; 'ambjax simulate' ignores this table
# design = "random"           # or {designs}
# plant.m = {{ percent = 10 }}  # uniform, +-10 % of the value above; the controller's model keeps that value
# plant.k_z = {{ percent = 10, shape = "normal" }}         # standard deviation 10 %, cut off at 6 standard deviations
# initial.z = {{ normal = 1e-4 }}                          # standard deviation, in m
# disturbance.q_z.amplitude = {{ log-uniform = [0.1, 2.0] }}
# disturbance.q_z.shift = {{ uniform = [-0.1, 0.1] }}      # s; start and stop of the pulse together
# actuator.u_max = {{ choices = [200, 500, 1000] }}        # V; equally likely
"""


def _lines(kind: type, values: object) -> list[str]:
    lines = []
    for field in dataclasses.fields(kind):
        value = getattr(values, field.name)
        if value is None:
            continue
        unit = f"{field.metadata['unit']}; " if field.metadata["unit"] else ""
        lines.append(_with_note(f"{field.name} = {_number(value)}", unit + field.metadata["doc"]))
    return lines


IRON = """\
# [plant.iron]                # iron of the true plant (left out: ideal iron); without a key, its effect is left out
# saturation = 1.4            # T; flux density limit of the core
# leakage = 1.1               # flux of a coil over the flux of its gap, at z = 0
# eddy = 5e-5                 # s; lag of the flux behind the current by eddy currents
"""


def _law(kind: type) -> list[str]:
    """Return the lines of a law. If its steepness p scales with the plant, the line of p is a comment."""
    law = kind()
    scaled, lines = law.size(Plant()) is not None, _lines(kind, law)
    return [
        line.replace("p =", "# p =").replace("  #", "#", 1) if scaled and line.startswith("p = ") else line
        for line in lines
    ]


def _others(kinds: dict[str, type]) -> str:
    return ", ".join(f'"{kind}"' for kind in list(kinds)[1:])


def _with_note(text: str, comment: str) -> str:
    return f"{text:<29} # {comment}"


def _tune() -> list[str]:
    """Return the lines of [tune], all of them comments."""
    head = ("# [tune]", "for 'ambjax tune', which starts at the gains above. Values are defaults unless noted")
    rows = [(f"# {line.text}" if line.text else "#", line.comment) for line in tune_table.template_lines()]
    return [_with_note(*row) if len(row[0]) < 30 else f"{row[0]}  # {row[1]}" for row in [head, *rows]]


def _number(value: float) -> str:
    text = repr(float(value)) if math.isfinite(value) else "inf"
    return text if "." in text or "e" in text or text == "inf" else text + ".0"


def template(scenario: str) -> str:
    """Return an annotated case file: the paper's "tracking" or "regulation" with repaired gains, or one of MACHINES.

    Raises ValueError for another name.
    """
    known = ["tracking", "regulation", *MACHINES]
    if scenario not in known:
        raise ValueError(f"template = {scenario!r}: it must be one of {', '.join(known)}.")
    if scenario in MACHINES:
        return MACHINES[scenario]
    tracking = scenario == "tracking"
    lines = [HEAD.format(title=f"the paper's {scenario} scenario, Table 2 with gamma = 7.5e4")]
    kinds = _with_note('# kind = "lumped"', f"Eqs. (1), (2); or {_others(PLANTS)}: each coil's own current")
    lines += [
        "[plant]                       # the true plant, Table 1",
        kinds,
        *_lines(Plant, Plant()),
        "",
        *IRON.splitlines(),
        "",
    ]
    lines += [
        "[controller]",
        "model = {}                    # numbers of the controller's model that differ from the plant: { m = 0.6 }",
    ]
    for stage, kinds in KINDS.items():
        kind, law = next(iter(kinds.items()))
        lines += ["", f"[controller.{stage}]", _with_note(f'kind = "{kind}"', f"or {_others(kinds)}"), *_law(law)]
    lines += ["", _with_note("[reference]", f"in m: {', '.join(SIGNALS)}; left out: 0")]
    if tracking:
        lines += ['kind = "sine"', *_lines(type(REFERENCE), REFERENCE)]
    else:
        lines += ['kind = "constant"', "value = 0.0                   # m"]
    lines += [
        "",
        "[disturbance.q_z]             # likewise [disturbance.q_i], in A/s, and [disturbance.base], the acceleration",
    ]
    lines += [
        "#                               of the housing, m/s^2; several: [[disturbance.q_z]] each (left out: none)"
    ]
    lines += ['kind = "pulse"', _with_note('unit = "A^2/m^2"', 'scaled force; or "N", or "m/s^2", the default')]
    lines += _lines(type(PULSE), PULSE)
    designs = " or ".join(f'"{d}"' for d in list(DESIGNS)[1:])
    rest = REST.format(paper_std=TABLE_2.noise_std, designs=designs)
    return "\n".join(lines) + "\n" + rest + "\n" + "\n".join(_tune()) + "\n"
