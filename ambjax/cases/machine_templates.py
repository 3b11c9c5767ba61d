"""Annotated case files of whole machines: a rigid rotor on five axes, and a flexible rotor from its geometry."""

MACHINE = """\
# A case for ambjax: a rigid rotor on five magnetic bearing axes, on a 20 kHz processor.
# Units are SI unless a comment says otherwise. Run it with 'ambjax simulate', analyse it with 'ambjax sensitivity'.
# Source: Math. Probl. Eng. 2011, 414286, Table 1: mass, inertia, places, gap, k_i = 38 N/A and k_s = 144 kN/m, from
# which bias and area follow for the assumed turns. "Assumed": not published.

[rotor]
kind = "rigid"                # or "modal" with [[rotor.modes]]; "shaft": from its geometry
m = 2.3                       # kg
I_t = 0.06                    # kg m^2; about an axis across the shaft
I_p = 8e-4                    # kg m^2; about the shaft
gravity = [0.0, -9.81, 0.0]   # m/s^2; along x, y and the shaft z: a horizontal rotor
speed = 6000.0                # rpm; at t = 0. Assumed
# acceleration = 3000.0       # rpm/s; a run-up (left out: constant speed)

[[bearing]]                   # two axes, left.x and left.y
name = "left"
kind = "radial"
at = -0.139                   # m; place of the magnet, from the centre of mass
sensor_at = -0.119            # m; place of the sensor (left out: that of the magnet)
# stop_at = -0.17             # m; place of the touchdown bearing (left out: that of the magnet)
# clearance = 1.9e-4          # m; its clearance (left out: run.clearance, or else 0.9 of s_0)
# angle = 45.0                # degrees; direction of the first axis, from x (left out: 0)

[[bearing]]
name = "right"
kind = "radial"
at = 0.241                    # m

[[bearing]]                   # one axis, thrust.z
name = "thrust"
kind = "axial"

[[unbalance]]
at = 0.05                     # m; assumed
amount = 20.0                 # g mm; assumed
phase = 0.0                   # degrees

[[load]]                      # any signal, in N, at a place and in a direction
at = 0.0                      # m
direction = [0.0, 1.0, 0.0]
kind = "step"
amplitude = 5.0               # N; assumed
start = 0.1                   # s

[plant]                       # the magnet of every axis; [bearing.plant] changes one bearing
mu_0 = 1.2566e-6              # N/A^2; air
n = 200.0                     # 1; assumed
A = 7.6e-5                    # m^2
s_0 = 3.81e-4                 # m
i_0 = 1.444                   # A
R = 1.0                       # ohm; assumed

[controller.observer]         # the controller of every axis, with the mass and the weight that the axis carries
kind = "kalman"

[controller.position]
kind = "integral-sliding-mode"  # all gains have their defaults

[processor]
delay = 1.0                   # samples

[sensor]
velocity = false
std = 2e-7                    # m; assumed
bits = 14

[actuator]
u_max = 48.0                  # V; assumed

[initial]
q = [2e-5, -3e-5, 1e-5, 1e-4, 0.0]  # x, y, z (m) of the centre of mass, beta_x, beta_y (rad); at rest

[clock]
duration = 0.2                # s
sample_period = 5e-5          # s

[run]
settle = 0.05                 # s

[sensitivity]
speeds = [0.0, 6000.0, 12000.0]  # rpm
"""

# The end of both flexible rotors, before the speeds of the sensitivity.
FLEXIBLE_END = """\
[processor]
delay = 1.0                   # samples

[sensor]
velocity = false
std = 2e-7                    # m; assumed

[actuator]
u_max = 48.0                  # V; assumed

[initial]
q = [1e-5, 0.0, 0.0, 0.0, 0.0]  # x, y, z (m) of the centre of mass, beta_x, beta_y (rad); at rest

[clock]
duration = 0.4                # s
sample_period = 5e-5          # s

[run]
settle = 0.2                  # s

[sensitivity]
"""

FLEXIBLE = (
    """\
# A case for ambjax: a flexible rotor on two radial magnetic bearings, from its geometry, on a 20 kHz processor.
# Units are SI unless a comment says otherwise. Run it with 'ambjax simulate', analyse it with 'ambjax sensitivity'.
# Source: AMrotor, Technical University of Munich, the magnetic-bearing test rig: shaft, discs, magnets with
# k_i = 50 N/A and k_s = 1e5 N/m. Its sensors are 42 mm beside the magnets; here they are at the magnets.

[rotor]
kind = "shaft"                # Timoshenko finite elements; places are measured from the left end
E = 211e9                     # Pa
rho = 7860.0                  # kg/m^3
nu = 0.3
modes = 6                     # bending modes; their shapes at the bearings and loads follow from the geometry
damping = 0.003               # damping ratio of the modes; measured on the rig: 0.0016 to 0.007
speed = 3000.0                # rpm
elements = [                  # sections from the left end, m
  { length = 0.094, diameter = 8.0e-3 },
  { length = 0.038, diameter = 9.6e-3 },
  { length = 0.218, diameter = 8.0e-3 },
  { length = 0.026, diameter = 9.6e-3 },
  { length = 0.228, diameter = 8.0e-3 },
  { length = 0.038, diameter = 9.6e-3 },
  { length = 0.060, diameter = 8.0e-3 },
]
discs = [
  { at = 0.113, m = 0.85074, I_t = 4.840066e-4, I_p = 4.036839e-4 },
  { at = 0.363, m = 1.276499, I_t = 1.487212e-3, I_p = 2.832751e-3 },
  { at = 0.623, m = 0.85074, I_t = 4.840066e-4, I_p = 4.036839e-4 },
]

[[bearing]]
name = "left"
kind = "radial"
at = 0.113                    # m
# sensor_at = 0.155           # m; the sensors of the rig are at 0.071 and 0.155, 0.581 and 0.665

[[bearing]]
name = "right"
kind = "radial"
at = 0.623                    # m

[[unbalance]]
at = 0.363                    # m; on the middle disc
amount = 10.0                 # g mm; assumed

[plant]                       # the magnet of every axis
mu_0 = 1.2566e-6              # N/A^2; air
n = 208.0                     # 1; 2 x 104 turns
A = 3.587e-4                  # m^2
s_0 = 7.8e-4                  # m
i_0 = 1.56                    # A
R = 1.0                       # ohm; assumed

[controller.observer]
kind = "kalman"

[controller.position]
kind = "sliding-mode"

"""
    + FLEXIBLE_END
    + "speeds = [0.0, 3000.0, 6000.0]  # rpm\n"
)
