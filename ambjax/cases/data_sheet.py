"""Annotated case files: a bearing from a data sheet, and that of a laboratory."""

BEARING = """\
# A case for ambjax: a radial magnetic bearing from a data sheet, on a 16 kHz processor, its rotor at rest.
# Units are SI. 'ambjax template' lists every other key. Run it with 'ambjax simulate', tune it with 'ambjax tune'.
# "Data sheet": the number is usually specified. "Assumed": the data sheet omits the number; it is chosen so that the
# magnet is plausible: a bias flux density of 0.75 T, a force of 15 weights ('ambjax check' prints both), 23 mH.

[plant]
# kind = "two-coil"           # each coil has its own current: use it for your own machine, and tune the gains on it
m = 2.4                       # kg; data sheet
k_z = 0.0                     # N/m; no passive bearing
mu_0 = 1.2566e-6              # N/A^2; air
n = 300.0                     # 1; assumed: 2 x 150 turns
A = 2.0e-4                    # m^2; assumed: 2.2 cm^2 per pole times cos(22.5 degrees), the angle of a pole to the axis
s_0 = 5e-4                    # m; data sheet
i_0 = 2.0                     # A; data sheet: bias
R = 1.0                       # ohm; assumed: 300 turns of about 0.08 m of wire 0.8 mm thick, warm
g = 9.81                      # m/s^2

[controller.observer]         # data sheet: the velocity is not measured
kind = "kalman"
w = 1700.0                    # 1/s; 'ambjax tune' found this and the gains below under [tune.limits]; rounded

[controller.position]
kind = "integral-sliding-mode"  # its integral leaves no offset after the step
c = 380.0                     # 1/s
c_int = 1.3e5                 # 1/s^2
k = 50.0                      # m/s^2
p = 380.0                     # s/m

[controller.inversion]
kind = "adaptive"
gamma = 1.8e12                # A^2/m^2/s
p = 3.5e-9                    # m^2/A^2

[controller.current]
kind = "sliding-mode"
k_i = 3200.0                  # A/s
p = 0.68                      # 1/A

[[disturbance.q_z]]           # data sheet: a step of 20 N
kind = "step"
unit = "N"
amplitude = 20.0              # N
start = 0.1                   # s

[[disturbance.q_z]]           # data sheet: 8 N at 300 Hz
kind = "sine"
unit = "N"
amplitude = 8.0               # N
frequency = 300.0             # Hz

[processor]
delay = 1.0                   # samples; data sheet

[sensor]
std = 3e-7                    # m; assumed: position sensors of this kind have 0.1 to 1 um rms
std_i = 2e-3                  # A; assumed: 0.1 % of the bias
velocity = false
bits = 14                     # data sheet; over +-s_0 and +-2 i_0, so 61 nm a step

[actuator]
u_max = 72.0                  # V; data sheet
i_max = 2.0                   # A; assumed: an amplifier of 4 A, less the bias

[initial]
z = 5e-5                      # m; off centre, at rest

[clock]
duration = 0.3                # s
sample_period = 6.25e-5       # s; data sheet: 16 kHz

[run]
settle = 0.05                 # s; time from which "settled" metrics count
clearance = 2.5e-4            # m; touchdown bearings usually limit |z| to half of the gap

[spread]                      # data sheet: the plant is known to 10 %; the controller's model keeps the values above
plant.m = { percent = 10 }    # uniform
plant.A = { percent = 10 }
plant.R = { percent = 10 }
initial.z = { uniform = [-1e-4, 1e-4] }  # m

[tune.limits]                 # of 'ambjax tune'
rms_u_V = 8.0                 # V; root mean square voltage
chatter_V_per_s = 5e4         # V/s; variation of the voltage
"""


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
