"""Fan charts of simulated ensembles: every median lies in its bands, and no curve moves before its cause."""

import tomllib

import numpy as np
import pytest
from profiles import thorough

from ambjax.cases.reader import case_from
from ambjax.commands.study_report import _quantiles
from ambjax.pictures import ensembles
from ambjax.results.spread_runs import study_of

# A step in the force at 10 ms, under a once-per-revolution motion of 540 Hz that the members share.
BLOWER = """
[plant]
{plant}
m = 5.8
k_z = 0.0
n = 120.0
A = 6.0e-4
s_0 = 4e-4
i_0 = 2.5
R = 0.45
g = 0.0
{laws}
[[disturbance.q_z]]
kind = "step"
unit = "N"
amplitude = {force}
start = 0.01
[[disturbance.q_z]]
kind = "sine"
unit = "N"
amplitude = 3.0
frequency = 540.0
[sensor]
std = 1.5e-7
std_i = 5e-3
{sensor}
[actuator]
u_max = 148.0
[clock]
duration = 0.016
sample_period = 1e-4
[spread]
plant.m = {{ percent = 15 }}
initial.z = {{ uniform = [-{start}, {start}] }}
"""
PROCESSOR = "[processor]\ndelay = 1.0\n"
PID = """[controller.observer]
kind = "kalman"
[controller.position]
kind = "pid"
[controller.inversion]
kind = "linearised"
[controller.current]
kind = "pi"
"""
CHATTERING = """[controller.inversion]
gamma = 1e10
[controller.position]
c = 400.0
k = 20.0
[controller.current]
k_i = 1000.0
"""
FANS = {
    # plant, laws, sensor, largest initial |z|
    "pid": ('kind = "two-coil"', PID + PROCESSOR, "velocity = false\nbits = 12\nrange_z = 3e-4", 5e-5),
    "chattering": ("", CHATTERING + PROCESSOR + 'discretisation = "explicit"\n', "", 1e-5),
    "some lost": ('kind = "two-coil"', PID + PROCESSOR, "velocity = false", 3.5e-4),
    "continuous": ("", PID.replace("kalman", "direct"), "", 5e-5),
}
DRAWN = [thorough("pid", 1), thorough("chattering", 4), ("some lost", 4), ("continuous", 1)]


def fan_of(name, force, every):
    """Draw the fan of an ensemble. Return the instants, and the median and the bands of each quantity as drawn."""
    plant, laws, sensor, start = FANS[name]
    found = case_from(tomllib.loads(BLOWER.format(plant=plant, laws=laws, sensor=sensor, start=start, force=force)))
    study = study_of(found, 3, 16)
    data = study.bands(16, found.clock.samples // every)
    shown = {name: _quantiles(x, data.extremes.get(name)) for name, x in data.signals.items()}
    panels = ensembles.fan(data.t, shown, {}, "", data.trajectory.lost_at, np.zeros(16)).axes[: len(shown)]
    return data, {name: (ax.lines[0], ax.collections) for name, ax in zip(shown, panels, strict=True)}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "every"), DRAWN)
def test_every_median_lies_in_its_bands_and_moves_after_its_cause(name, every):
    _, before = fan_of(name, 0.0, every)
    data, panels = fan_of(name, 30.0, every)
    lost = np.isfinite(data.trajectory.lost_at)
    assert (0 < lost.sum() < 16) if name == "some lost" else not lost.any()
    for quantity, (line, bands) in panels.items():
        t, median = line.get_data()
        np.testing.assert_array_equal(t, data.t)
        some = np.isfinite(median)
        for band in bands:
            low, high = (np.full(len(t), x) for x in (np.inf, -np.inf))
            for x, y in band.get_paths()[0].vertices:
                k = np.argmin(np.abs(t - x))
                low[k], high[k] = min(low[k], y), max(high[k], y)
            assert np.all(low[some] <= median[some])
            assert np.all(median[some] <= high[some])
        # u_mean is the mean over the sample that begins at its instant: the last one before 10 ms begins at 9.9 ms
        same = (median == before[quantity][0].get_ydata()) | ~some
        assert same[t < 0.00985].all(), quantity
        assert not same[t > 0.013].all(), quantity
