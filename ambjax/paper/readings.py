"""The paper's simulation study, Section 4: its numbers, its two scenarios, and four readings of them.

D. Papageorgiou and I. Santos, "Sliding Mode Control of Active Magnetic Bearings - A Cascaded Architecture".

literal: Table 2 as printed; the disturbance is an acceleration q_z = Q_z = 1 m/s^2, as in Eq. (1).
repaired: gamma = 7.5e4 instead of 1000, so that Eq. (7) holds. The disturbance is a scaled magnetic force of 1 A^2/m^2,
as in the text of the paper, so q_z = a Q_z = 0.141 m/s^2.
tuned: the disturbance of `repaired`, the paper's noise on z (held for 100 us), and a supply of 200 V. The observer and
the gains are those that `ambjax tune benchmarks/tasks/C.toml` found; a search today may find others.
sampled: as `tuned`, on a processor of 10 kHz whose voltage acts one sample late, with set-valued signs.
`ambjax tune benchmarks/tasks/sampled/C10-robust.toml` found the gains, for plants off by up to 10 %.

The paper does not give the times of the pulse, the initial state or the sample time of the noise. Here the pulse acts
from 0.8 s to 1.3 s of 2 s, the initial state is zero, and the sample time is that of the clock (CLOCK: 100 us).
"""

import dataclasses
import math
from typing import NamedTuple

from ambjax.control import current, inversion, observer, position
from ambjax.control.cascade import Cascade
from ambjax.control.processor import Processor
from ambjax.simulation.clock import Clock
from ambjax.world.scenario import Scenario
from ambjax.world.sensor import Sensor
from ambjax.world.waveforms import Pulse, Sine


class Table2(NamedTuple):
    """Table 2 and the noise of Section 4, as printed, in SI units. All three smoothed signs have the same p."""

    A_r: float = 0.0025
    f_r: float = 2.0
    c: float = 17.0
    k: float = 25.0
    gamma: float = 1000.0
    k_i: float = 152.0
    p: float = 25.0
    Q_z: float = 1.0
    noise_variance: float = 1e-7

    @property
    def noise_std(self) -> float:
        """Standard deviation, m, from the printed variance. The paper prints the variance in m; its unit is m^2."""
        return self.noise_variance**0.5


TABLE_2 = Table2()
REPAIRED_GAMMA = 7.5e4
REFERENCE = Sine(TABLE_2.A_r, TABLE_2.f_r)
PULSE = Pulse(TABLE_2.Q_z, 0.8, 1.3)
SETTLE = 0.5
CLOCK = Clock(samples=20_000, sample_period=1e-4)
READINGS = ("literal", "repaired", "tuned", "sampled")
# The readings with the paper's noise and a finite supply; the others have neither.
NOISY = ("tuned", "sampled")
# Supply of the noisy readings, V.
SUPPLY = 200.0


class Tuned(NamedTuple):
    """Gains that `ambjax tune` found, to four digits. The defaults are those for benchmarks/tasks/C.toml."""

    c: float = 1743.0
    k: float = 291.6
    gamma: float = 1.467e6
    k_i: float = 18.15
    l: float = 1.019


TUNED = Tuned()
# The gains for benchmarks/tasks/sampled/C10-robust.toml; c and l are at bounds of the search.
SAMPLED = Tuned(c=2000.0, k=3.918, gamma=1.552e6, k_i=1.325e4, l=0.05)
PROCESSOR = Processor(delay=1.0)


def cascade(reading: str) -> Cascade:
    """Return the paper's controller in a reading."""
    t = TABLE_2
    if reading in NOISY:
        gains, p = (TUNED, t.p) if reading == "tuned" else (SAMPLED, math.inf)
        return Cascade(
            observer=observer.Complementary(gains.l, 0.0),
            position=position.SlidingMode(gains.c, gains.k, p),
            inversion=inversion.Adaptive(gains.gamma, p),
            current=current.SlidingMode(gains.k_i, p),
            processor=None if reading == "tuned" else PROCESSOR,
        )
    gamma = t.gamma if reading == "literal" else REPAIRED_GAMMA
    return Cascade(
        position=position.SlidingMode(t.c, t.k, t.p),
        inversion=inversion.Adaptive(gamma, t.p),
        current=current.SlidingMode(t.k_i, t.p),
    )


def on_processor(reading: str) -> Cascade:
    """Return the controller of a reading on the processor of `sampled`."""
    return dataclasses.replace(cascade(reading), processor=PROCESSOR)


def scenario(name: str, reading: str, *, pulse: bool = True) -> Scenario:
    """Return the "regulation" or "tracking" scenario in a reading; `pulse` False: without the disturbance.

    Only the readings in NOISY have noise and a supply limit.
    """
    reference = dataclasses.replace(REFERENCE, amplitude=REFERENCE.amplitude if name == "tracking" else 0.0)
    none = dataclasses.replace(PULSE, amplitude=0.0)
    acting = PULSE if pulse else none
    literal = reading == "literal"
    quiet = Scenario(reference=reference, q_z=acting if literal else none, q_v=none if literal else acting)
    return noisy(quiet) if reading in NOISY else quiet


def noisy(scenario: Scenario) -> Scenario:
    """Return the scenario with the paper's noise on z, held for one sample, and a supply of SUPPLY."""
    return dataclasses.replace(scenario, sensor=Sensor(TABLE_2.noise_std), u_max=SUPPLY)
