"""Annotated case file of a whole machine: a flexible rotor whose magnets are at 45 degrees."""

from ambjax.cases.machine_templates import FLEXIBLE_END

UFU = (
    """\
# A case for ambjax: a flexible rotor on two radial magnetic bearings at 45 degrees, from its geometry, on a 20 kHz
# processor. Units are SI unless a comment says otherwise. Run it with 'ambjax simulate', analyse it with
# 'ambjax sensitivity'. Source: amb_models.py of ROSS (Apache-2.0), the test rig of the Federal University of Uberlandia
# (UFU): geometry, gap, bias, turns, pole area and k_i = 55.7 N/A, k_s = 1.29e5 N/m. "Assumed": not published.

[rotor]
kind = "shaft"                # Timoshenko finite elements; places are measured from the left end
E = 190e9                     # Pa
rho = 7850.0                  # kg/m^3
nu = 0.3
modes = 4                     # bending modes: 104, 400, 768 and 1118 Hz
damping = 0.005               # damping ratio of the modes; assumed
speed = 6000.0                # rpm; assumed
elements = [                  # sections from the left end, m
  { length = 0.0120, diameter = 0.00635 },
  { length = 0.0800, diameter = 0.032 },
  { length = 0.0733, diameter = 0.0348 },
  { length = 0.0252, diameter = 0.0499 },
  { length = 0.1675, diameter = 0.01905 },
  { length = 0.0125, diameter = 0.054 },
  { length = 0.1651, diameter = 0.01905 },
  { length = 0.0251, diameter = 0.0499 },
  { length = 0.0734, diameter = 0.0348 },
  { length = 0.0120, diameter = 0.00635 },
]
discs = [                     # the laminations of both magnets, and the disc in three parts
  { at = 0.1120, m = 0.0675344, I_t = 1.601550e-05, I_p = 3.115935e-05 },
  { at = 0.1208, m = 0.0491159, I_t = 1.149832e-05, I_p = 2.266134e-05 },
  { at = 0.1272, m = 0.0575577, I_t = 1.354793e-05, I_p = 2.655626e-05 },
  { at = 0.1348, m = 0.0437439, I_t = 1.020982e-05, I_p = 2.018276e-05 },
  { at = 0.1405, m = 0.0491159, I_t = 1.149832e-05, I_p = 2.266134e-05 },
  { at = 0.1469, m = 0.0468136, I_t = 1.094471e-05, I_p = 2.159909e-05 },
  { at = 0.1530, m = 0.047581, I_t = 1.112901e-05, I_p = 2.195318e-05 },
  { at = 0.1592, m = 0.047581, I_t = 1.112901e-05, I_p = 2.195318e-05 },
  { at = 0.3580, m = 0.283213, I_t = 3.068846e-04, I_p = 6.130139e-04 },
  { at = 0.3640, m = 0.495622, I_t = 5.384109e-04, I_p = 1.072774e-03 },
  { at = 0.3705, m = 0.991244, I_t = 1.088965e-03, I_p = 2.145549e-03 },
  { at = 0.5669, m = 0.047581, I_t = 1.112901e-05, I_p = 2.195318e-05 },
  { at = 0.5731, m = 0.047581, I_t = 1.112901e-05, I_p = 2.195318e-05 },
  { at = 0.5792, m = 0.0468136, I_t = 1.094471e-05, I_p = 2.159909e-05 },
  { at = 0.5856, m = 0.0491159, I_t = 1.149832e-05, I_p = 2.266134e-05 },
  { at = 0.5913, m = 0.0437439, I_t = 1.020982e-05, I_p = 2.018276e-05 },
  { at = 0.5989, m = 0.0575577, I_t = 1.354793e-05, I_p = 2.655626e-05 },
  { at = 0.6053, m = 0.0491159, I_t = 1.149832e-05, I_p = 2.266134e-05 },
  { at = 0.6141, m = 0.0675344, I_t = 1.601550e-05, I_p = 3.115935e-05 },
]

[[bearing]]
name = "left"
kind = "radial"
at = 0.1530                   # m
angle = 45.0                  # degrees; direction of the first axis, from x

[[bearing]]
name = "right"
kind = "radial"
at = 0.5669                   # m
angle = 45.0                  # degrees

[[unbalance]]
at = 0.364                    # m; on the disc
amount = 10.0                 # g mm; assumed

[plant]                       # the magnet of every axis
mu_0 = 1.2566e-6              # N/A^2; air
n = 138.0                     # 1
A = 4.346e-4                 # m^2; 470.3 mm^2 cos(0.392 rad)
s_0 = 4.32e-4                 # m
i_0 = 1.0                     # A
R = 1.0                       # ohm; assumed

[controller.observer]          # no model: that of the Kalman filter is rigid
kind = "difference"
w = 2e4                       # 1/s

[controller.position]
kind = "pid"                  # low gains: the first bending mode is at 104 Hz
k_p = 4e4                     # 1/s^2
k_int = 4e5                   # 1/s^3
k_d = 300.0                   # 1/s
w_f = 1.5e4                   # 1/s

"""
    + FLEXIBLE_END
    + "speeds = [0.0, 3000.0, 6000.0, 10000.0]  # rpm\n"
)
