"""Annotated case file of a laboratory bearing, whose coils have 15 mH (the paper's have 33 H)."""

RIG = """\
# A case for ambjax: a laboratory's radial magnetic bearing on a 20 kHz processor, its rotor at rest.
# Units are SI. 'ambjax template' lists every other key. Run it with 'ambjax simulate', tune it with 'ambjax tune'.
# Sources: [1] AMrotor, Technical University of Munich, the bearing of TU Darmstadt in Config_Sim_Mag1.m. [2] MALTA, ETH
# Zurich, firmware of bearingless machines. [3] Math. Probl. Eng. 2011, 414286, Table 1: a rotor of 2.3 kg, gap 0.38 mm.

[plant]
m = 1.64                      # kg; half of the rotor of 3.27 kg of [1], which has two bearings
k_z = 0.0                     # N/m; no passive bearing
mu_0 = 1.2566e-6              # N/A^2; air
n = 208.0                     # 1; 2 x 104 turns [1]
A = 2.68e-4                   # m^2; 2.9 cm^2 per pole times cos(22.5 degrees), the angle of a pole to the axis [1]
s_0 = 5e-4                    # m; between the 0.38 mm of [3] and the 0.78 mm of [1]. So L = mu_0 n^2 A/(2 s_0) = 15 mH
i_0 = 2.5                     # A; bias [1]
R = 1.0                       # ohm; estimate, not published: 208 turns of about 0.2 m of wire 1 mm thick
g = 9.81                      # m/s^2

[controller.observer]         # the velocity is not measured
kind = "kalman"
w = 1000.0                    # 1/s; 'ambjax tune' found this and the gains below from a rough guess; rounded

[controller.position]
kind = "sliding-mode"
c = 2900.0                    # 1/s
k = 9.0                       # m/s^2
p = inf                       # s/m; set-valued sign, implicit steps

[controller.inversion]
kind = "adaptive"
gamma = 7e11                  # A^2/m^2/s
p = inf                       # m^2/A^2

[controller.current]
kind = "sliding-mode"
k_i = 1100.0                  # A/s
p = inf                       # 1/A

[disturbance.q_z]             # 1.6 N, a tenth of the rotor's weight
kind = "pulse"
amplitude = 1.0               # m/s^2
start = 0.1                   # s
stop = 0.2                    # s

[processor]
delay = 1.0                   # samples; the voltage computed from a sample acts from the next sample on [2]

[sensor]
std = 5e-7                    # m; position sensors of this kind have 0.1 to 1 um rms
std_i = 5e-3                  # A; about one step of the converter
velocity = false
bandwidth = 1e4               # Hz; low-passes of 1 to 10 kHz [2]
bits = 12                     # [2]
range_z = 2.048e-3            # m; 1 um per step; 0.9 to 1.13 um in [2]
range_i = 10.0                # A; limit of the amplifiers of [2]

[actuator]
u_max = 48.0                  # V; a DC link of 50 V [2]
i_max = 2.5                   # A; an amplifier of 5 A [1], less the bias

[initial]
z = 5e-5                      # m; off centre, at rest

[clock]
duration = 0.3                # s
sample_period = 5e-5          # s; position and current control at 20 kHz [2]

[run]
settle = 0.05                 # s; time from which "settled" metrics count
clearance = 2.5e-4            # m; touchdown bearings usually limit |z| to half of the gap

[spread]
plant.m = { percent = 10 }    # uniform; the controller's model keeps the values above
plant.A = { percent = 10 }
initial.z = { uniform = [-1e-4, 1e-4] }  # m
"""
