"""Mutations: one line of the program broken, and the test that must notice. See tests/mutate.py.

To add one: what the mutant does wrong, the file, a piece of its text that is found there exactly once, what stands
there instead, and the smallest test that fails then. Pieces are short, so that a change of the code beside them
leaves them alone; where the code itself changes, the mutation is adapted with it.
"""

from typing import NamedTuple


class Mutation(NamedTuple):
    """`says` in words, `file` from the project's root, `old` and `new` text, `test` as pytest names it."""

    says: str
    file: str
    old: str
    new: str
    test: str


M = Mutation
PLANT = [
    M(
        "the sign of the motional term of Eq. (2) is turned",
        "ambjax/plant.py",
        "i_dot = 2 * z_dot * gaps.inverses[1] * i +",
        "i_dot = -2 * z_dot * gaps.inverses[1] * i +",
        "tests/test_plant.py::test_rates_are_equations_1_and_2_written_out",
    ),
    M(
        "one passive bearing instead of two",
        "ambjax/plant.py",
        "z_ddot = 2 * self.k_z / self.m * z",
        "z_ddot = self.k_z / self.m * z",
        "tests/test_plant.py::test_rates_are_equations_1_and_2_written_out",
    ),
    M(
        "the plant's voltage drives the upper gap",
        "ambjax/plant.py",
        "(2 / self.kappa) * gaps.lower *",
        "(2 / self.kappa) * gaps.upper *",
        "tests/test_plant.py::test_rates_are_equations_1_and_2_written_out",
    ),
    M(
        "the second coil does not heat",
        "ambjax/plant.py",
        "2 * self.R * (self.i_0**2 + jnp.asarray(i) ** 2)",
        "self.R * (self.i_0 + jnp.asarray(i)) ** 2",
        "tests/test_plant.py::test_rates_are_equations_1_and_2_written_out",
    ),
    M(
        "the scaled force acts on half the mass",
        "ambjax/plant.py",
        "self.kappa / (4 * self.m)",
        "self.kappa / (2 * self.m)",
        "tests/test_plant.py::test_derived_constants_of_table_1",
    ),
]
LAWS = [
    M(
        "the position law forgets the second passive bearing",
        "ambjax/control/position.py",
        "wanted = -2 * model.k_z",
        "wanted = -model.k_z",
        "tests/test_laws.py::test_equation_5_sets_the_rate_of_sigma",
    ),
    M(
        "the position law forgets the reference's acceleration",
        "ambjax/control/position.py",
        "(wanted + reference.r_ddot + model.g + robust)",
        "(wanted + model.g + robust)",
        "tests/test_laws.py::test_equation_5_sets_the_rate_of_sigma",
    ),
    M(
        "the adaptive law does not divide by dv/di",
        "ambjax/control/inversion.py",
        "self.p, per=gradient)",
        "self.p)",
        "tests/test_laws.py::test_equation_6_gives_the_error_dynamics_of_equation_8",
    ),
    M(
        "the current law does not feed i_ref' forward",
        "ambjax/control/current.py",
        "measured.i + demand.i_ref_dot + robust",
        "measured.i + robust",
        "tests/test_laws.py::test_equation_11_gives_the_error_dynamics_of_equation_10",
    ),
    M(
        "the current law switches the wrong way",
        "ambjax/control/current.py",
        "robust = -self.k_i *",
        "robust = self.k_i *",
        "tests/test_laws.py::test_equation_11_gives_the_error_dynamics_of_equation_10",
    ),
    M(
        "the integral of the PI law winds up",
        "ambjax/control/current.py",
        "self.k_int * error + self.k_aw * excess",
        "self.k_int * error",
        "tests/test_laws.py::test_pi_integral_is_bounded_while_the_supply_saturates",
    ),
    M(
        "the observer is pulled away from the measurement",
        "ambjax/control/observer.py",
        "inputs.z_dot + self.l * (inputs.z - state)",
        "inputs.z_dot + self.l * (state - inputs.z)",
        "tests/test_laws.py::test_complementary_observer_forgets_its_error_at_rate_l_and_integrates_velocity_noise",
    ),
    M(
        "the position law stands before the observer",
        "ambjax/control/cascade.py",
        "self.position(self.model, (estimate, reference), positioned)",
        "self.position(self.model, (Measurement(z, z_dot, measured.i), reference), positioned)",
        "tests/test_laws.py::test_the_demand_s_rates_are_derivatives_along_the_nominal_flow",
    ),
    M(
        "the inversion law stands before the observer",
        "ambjax/control/cascade.py",
        "return (estimate.z, v_star), (estimate,",
        "return (z, v_star), (estimate,",
        "tests/test_laws.py::test_the_demand_s_rates_are_derivatives_along_the_nominal_flow",
    ),
]
LOOP = [
    M(
        "the supply's limit is ignored",
        "ambjax/loop.py",
        "return command, rates, _limited(command.u, u_max)",
        "return command, rates, command.u",
        "tests/test_rollout.py::test_the_supply_limits_the_voltage_that_is_applied",
    ),
    M(
        "the sliding step ignores the supply's limit",
        "ambjax/sliding.py",
        "u = jnp.clip(u, -scenario.u_max, scenario.u_max)",
        "u = jnp.clip(u, -1e9, 1e9)",
        "tests/test_sliding.py::test_stiff_gains_under_held_noise_agree_with_error_control",
    ),
    M(
        "the rotor touches down at s_0",
        "ambjax/scenario.py",
        "return 0.9 * self.plant.s_0 if",
        "return self.plant.s_0 if",
        "tests/test_rollout.py::test_a_lost_rotor_is_frozen_and_finite",
    ),
    M(
        "a clearance that is given is ignored",
        "ambjax/scenario.py",
        "if self.clearance is None else self.clearance",
        "if self.clearance is None else 0.9 * self.plant.s_0",
        "tests/test_rollout.py::test_the_clearance_moves_the_stop",
    ),
    M(
        "the scaled force disturbs by half",
        "ambjax/scenario.py",
        "self.q_z(t) + self.plant.a * self.q_v(t)",
        "self.q_z(t) + self.plant.a / 2 * self.q_v(t)",
        "tests/test_rollout.py::test_repaired_regulation_offset_in_the_pulse",
    ),
    M(
        "noise is redrawn at each evaluation",
        "ambjax/loop.py",
        "self.rates(inputs, x, hold)  # noqa: E731",
        "self.rates(inputs, x, self.hold((x.plant.z * 1e18).astype(int)))  # noqa: E731",
        "tests/test_ensemble.py::test_settled_rms_agrees_with_the_lyapunov_equation",
    ),
    M(
        "noise is drawn once for all samples",
        "ambjax/rollout.py",
        "hold = system.hold(k)",
        "hold = system.hold(0)",
        "tests/test_ensemble.py::test_the_noise_of_a_member_is_its_own_and_white",
    ),
    M(
        "all members draw the same noise",
        "ambjax/scenario.py",
        "jax.random.fold_in(jax.random.key(self.seed), self.member)",
        "jax.random.fold_in(jax.random.key(self.seed), 0 * self.member)",
        "tests/test_noise.py::test_member_k_draws_the_same_noise_alone_and_in_a_batch",
    ),
    M(
        "a lost rotor goes on moving",
        "ambjax/rollout.py",
        "jnp.where(lost_now, a, b), resting, after.state",
        "jnp.where(lost_now, b, b), resting, after.state",
        "tests/test_rollout.py::test_a_lost_rotor_is_frozen_and_finite",
    ),
    M(
        "the drive of a lost rotor stays on",
        "ambjax/loop.py",
        "u=jnp.where(alive, u, 0.0)",
        "u=u",
        "tests/test_rollout.py::test_a_lost_rotor_is_frozen_and_finite",
    ),
]
METHODS = [
    M(
        "a coefficient of RODAS3 is off",
        "ambjax/integrate.py",
        "(-8.0 / 3.0, u_3)",
        "(-7.0 / 3.0, u_3)",
        "tests/test_integrate.py::test_order_on_a_problem_with_known_solution",
    ),
    M(
        "the last digit of a coefficient of DOP853 is off",
        "ambjax/explicit.py",
        "0.04471061572777259",
        "0.04471061572777359",
        "tests/test_integrate.py::test_dop853_meets_every_condition_of_order_eight",
    ),
    M(
        "a stage sees the jump at the end of its step",
        "ambjax/integrate.py",
        "inset = 4 * eps *",
        "inset = 0 * eps *",
        "tests/test_integrate.py::test_a_jump_on_the_edge_of_a_step_keeps_the_order",
    ),
    M(
        "a stalled integration counts as a rotor that is held",
        "ambjax/integrate.py",
        "jnp.where(stalled, STALLED, code)",
        "code",
        "tests/test_integrate.py::test_a_stalled_rollout_says_so_and_stays_finite",
    ),
    M(
        "the sliding step moves the rotor by its first acceleration alone",
        "ambjax/sliding.py",
        "z_ddot_1 = scenario.plant.z_ddot(ahead.z, i_ref + e, end.q_z)",
        "z_ddot_1 = z_ddot_0",
        "tests/test_sliding.py::test_the_slow_motion_is_of_second_order",
    ),
]
MUTATIONS = [*PLANT, *LAWS, *LOOP, *METHODS]
