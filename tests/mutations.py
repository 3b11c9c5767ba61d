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
        "ambjax/world/plant.py",
        "i_dot = 2 * z_dot * gaps.inverses[1] * i +",
        "i_dot = -2 * z_dot * gaps.inverses[1] * i +",
        "tests/test_plant.py::test_rates_are_equations_1_and_2_written_out",
    ),
    M(
        "one passive bearing instead of two",
        "ambjax/world/plant.py",
        "z_ddot = 2 * self.k_z / self.m * z",
        "z_ddot = self.k_z / self.m * z",
        "tests/test_plant.py::test_rates_are_equations_1_and_2_written_out",
    ),
    M(
        "the plant's voltage drives the upper gap",
        "ambjax/world/plant.py",
        "(2 / self.kappa) * gaps.lower *",
        "(2 / self.kappa) * gaps.upper *",
        "tests/test_plant.py::test_rates_are_equations_1_and_2_written_out",
    ),
    M(
        "the second coil does not heat",
        "ambjax/world/bearing.py",
        "2 * self.R * (self.i_0**2 + jnp.asarray(i) ** 2)",
        "self.R * (self.i_0 + jnp.asarray(i)) ** 2",
        "tests/test_plant.py::test_rates_are_equations_1_and_2_written_out",
    ),
    M(
        "the scaled force acts on half the mass",
        "ambjax/world/bearing.py",
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
        "return -self.k_i *",
        "return self.k_i *",
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
        "tests/test_order.py",
    ),
    M(
        "the inversion law stands before the observer",
        "ambjax/control/cascade.py",
        "return (estimate.z, v_star), (estimate, observed_rate,",
        "return (z, v_star), (estimate, observed_rate,",
        "tests/test_order.py",
    ),
]
LOOP = [
    M(
        "the supply's limit is ignored",
        "ambjax/simulation/loop.py",
        "return command, rates, limited(command.u, u_max)",
        "return command, rates, command.u",
        "tests/test_rollout.py::test_the_supply_limits_the_voltage_that_is_applied",
    ),
    M(
        "the sliding step ignores the supply's limit",
        "ambjax/simulation/sliding.py",
        "u = jnp.clip(u, -scenario.u_max, scenario.u_max)",
        "u = jnp.clip(u, -1e9, 1e9)",
        "tests/test_sliding.py::test_stiff_gains_under_held_noise_agree_with_error_control",
    ),
    M(
        "the rotor touches down at s_0",
        "ambjax/world/scenario.py",
        "return 0.9 * self.plant.s_0 if",
        "return self.plant.s_0 if",
        "tests/test_rollout.py::test_a_lost_rotor_is_frozen_and_finite",
    ),
    M(
        "a clearance that is given is ignored",
        "ambjax/world/scenario.py",
        "if self.clearance is None else self.clearance",
        "if self.clearance is None else 0.9 * self.plant.s_0",
        "tests/test_rollout.py::test_the_clearance_moves_the_stop",
    ),
    M(
        "the scaled force disturbs by half",
        "ambjax/world/scenario.py",
        "self.q_z(t) + self.plant.a * self.q_v(t)",
        "self.q_z(t) + self.plant.a / 2 * self.q_v(t)",
        "tests/test_rollout.py::test_repaired_regulation_offset_in_the_pulse",
    ),
    M(
        "noise is redrawn at each evaluation",
        "ambjax/simulation/loop.py",
        "seen = self.measured(state.plant, hold)",
        "seen = self.measured(state.plant, self.hold((state.plant.z * 1e18).astype(int)))",
        "tests/test_ensemble.py::test_settled_rms_agrees_with_the_lyapunov_equation",
    ),
    M(
        "noise is drawn once for all samples",
        "ambjax/simulation/rollout.py",
        "hold = system.hold(k)",
        "hold = system.hold(0)",
        "tests/test_ensemble.py::test_the_noise_of_a_member_is_its_own_and_white",
    ),
    M(
        "all members draw the same noise",
        "ambjax/world/scenario.py",
        "jax.random.fold_in(jax.random.key(self.seed), self.member)",
        "jax.random.fold_in(jax.random.key(self.seed), 0 * self.member)",
        "tests/test_noise.py::test_member_k_draws_the_same_noise_alone_and_in_a_batch",
    ),
    M(
        "a lost rotor goes on moving",
        "ambjax/simulation/rollout.py",
        "jnp.where(lost_now, a, b), resting, after.state",
        "jnp.where(lost_now, b, b), resting, after.state",
        "tests/test_rollout.py::test_a_lost_rotor_is_frozen_and_finite",
    ),
    M(
        "the drive of a lost rotor stays on",
        "ambjax/simulation/loop.py",
        "u=jnp.where(alive, command.u, 0.0)",
        "u=command.u",
        "tests/test_rollout.py::test_a_lost_rotor_is_frozen_and_finite",
    ),
]
METHODS = [
    M(
        "a coefficient of RODAS3 is off",
        "ambjax/simulation/integrate.py",
        "(-8.0 / 3.0, u_3)",
        "(-7.0 / 3.0, u_3)",
        "tests/test_integrate.py::test_order_on_a_problem_with_known_solution",
    ),
    M(
        "a digit of a coefficient of DOP853 is off",
        "ambjax/simulation/explicit.py",
        "0.04471061572777259",
        "0.04471061672777259",
        "tests/test_integrate.py::test_dop853_meets_every_condition_of_order_eight",
    ),
    M(
        "a stage sees the jump at the end of its step",
        "ambjax/simulation/integrate.py",
        "inset = 4 * eps *",
        "inset = 0 * eps *",
        "tests/test_integrate.py::test_a_jump_on_the_edge_of_a_step_keeps_the_order",
    ),
    M(
        "a stalled integration counts as a rotor that is held",
        "ambjax/simulation/integrate.py",
        "jnp.where(stalled, STALLED, code)",
        "code",
        "tests/test_integrate.py::test_a_stalled_rollout_says_so_and_stays_finite",
    ),
    M(
        "the sliding step moves the rotor by its first acceleration alone",
        "ambjax/simulation/sliding.py",
        "z_ddot_1 = scenario.plant.z_ddot(ahead.z, i_ref + e, end.q_z)",
        "z_ddot_1 = z_ddot_0",
        "tests/test_sliding.py::test_the_slow_motion_is_of_second_order",
    ),
    M(
        "a lost controller goes on stepping",
        "ambjax/simulation/rollout.py",
        "choose(alive, system.jump(just_after, state, hold), state)",
        "system.jump(just_after, state, hold)",
        "tests/test_jump.py::test_a_lost_state_jumps_no_more",
    ),
    M(
        "a rotor lost in the first part of a sample is lost in the second",
        "ambjax/simulation/integrate.py",
        "jnp.where(so_far.code == ALIVE, after.t, so_far.t)",
        "after.t",
        "tests/test_jump.py::test_the_time_of_a_loss_is_that_of_its_own_stretch",
    ),
]
NOISE = [
    M(
        "designs and signals share one random stream",
        "ambjax/world/scenario.py",
        "SIGNAL_STREAM = np.uint32(2**32 - 1), np.uint32(2**32 - 2)",
        "SIGNAL_STREAM = np.uint32(2**32 - 1), np.uint32(2**32 - 1)",
        "tests/test_streams.py::test_designs_and_signals_share_no_random_words",
    ),
    M(
        "sensor noise is made of the words of fold_in",
        "ambjax/numerics/gaussian.py",
        "STREAMS = 1, 2",
        "STREAMS = 0, 1",
        "tests/test_streams.py::test_noise_is_not_made_of_the_words_that_keys_are_made_of",
    ),
    M(
        "the noise of i is as large as that of z",
        "ambjax/numerics/gaussian.py",
        "second * cosine(other)",
        "first * cosine(other)",
        "tests/test_streams.py::test_the_noise_of_one_sensor_says_nothing_of_another_s",
    ),
    M(
        "the noise of z_dot is that of z but for its sign",
        "ambjax/numerics/gaussian.py",
        "first * sine(turn)",
        "jnp.abs(first * cosine(turn))",
        "tests/test_streams.py::test_the_noise_of_one_sensor_says_nothing_of_another_s",
    ),
]
ENSEMBLE = [
    M(
        "calls of an ensemble are put together in the wrong order",
        "ambjax/ensemble/engine.py",
        "parts = list(pool.map(self._one, starts))",
        "parts = list(pool.map(self._one, reversed(starts)))",
        "tests/test_ensemble.py::test_results_do_not_depend_on_calls_threads_or_who_runs_beside",
    ),
    M(
        "a member of a study is not the member of that number",
        "ambjax/ensemble/study.py",
        "return cascade, dataclasses.replace(scenario, seed=self.seed, member=members)",
        "return cascade, dataclasses.replace(scenario, seed=self.seed, member=members - members[0])",
        "tests/test_ensemble.py::test_members_npz_has_a_row_per_member_and_every_metric",
    ),
    M(
        "Wilson's interval forgets a term of its root",
        "ambjax/ensemble/intervals.py",
        "(share * (1 - share) + z2 / (4 * n))",
        "(share * (1 - share))",
        "tests/test_statistics.py::test_wilson_solves_its_own_equation",
    ),
    M(
        "a percentage spreads to one side",
        "ambjax/ensemble/distributions.py",
        "x = 2 * np.asarray(u) - 1 if",
        "x = np.asarray(u) if",
        "tests/test_spread.py::test_quantiles_are_scipy_s",
    ),
    M(
        "the uncertain plant is only 10 % above",
        "ambjax/paper/evidence.py",
        "for factor in (0.9, 1.1)",
        "for factor in (1.1, 1.1)",
        "tests/test_evidence.py",
    ),
    M(
        "a condition of the theorem holds where it fails",
        "ambjax/theorem/conditions.py",
        "one.unit, gain > against, path",
        "one.unit, gain < against, path",
        "tests/test_theorem.py::test_repaired_holds_and_literal_does_not",
    ),
]
SEARCH = [
    M(
        "who validates is who trained",
        "tuning/config.py",
        "int(np.uint32(budget.seed + 2_000_003))",
        "budget.seed",
        "tests/test_tuning_rounds.py::test_the_three_ensembles_have_seeds_of_their_own",
    ),
    M(
        "who judges is who trained",
        "tuning/config.py",
        "int(np.uint32(budget.seed + 1_000_001))",
        "budget.seed",
        "tests/test_tuning_rounds.py::test_the_three_ensembles_have_seeds_of_their_own",
    ),
    M(
        "who judges is who validated",
        "tuning/command.py",
        "held_out = seeds(tune.budget)[2]",
        "held_out = seeds(tune.budget)[1]",
        "tests/test_tuning_study.py::test_tuned_gains_are_judged_by_members_that_nothing_else_was_asked_of",
    ),
    M(
        "the validation ensemble is never asked",
        "tuning/search/rounds.py",
        "lost, worst = _lost(course.problem, x)",
        "lost, worst = np.zeros(0, int), np.arange(1)",
        "tests/test_tuning_rounds.py::test_members_of_another_seed_that_are_lost_join_and_are_held",
    ),
    M(
        "the answer that loses most is returned",
        "tuning/search/rounds.py",
        "best = min(answers, key",
        "best = max(answers, key",
        "tests/test_tuning_rounds.py::test_of_several_answers_that_lose_members_the_one_that_loses_least_is_returned",
    ),
    M(
        "members that accurate steps lose do not join",
        "tuning/search/rounds.py",
        "these = error.who._replace(",
        "these = jax.tree.map(lambda a: a[:0], error.who)._replace(",
        "tests/test_tuning_rounds.py::test_members_that_only_accurate_steps_lose_join_too",
    ),
    M(
        "the error of the step is always 0",
        "tuning/judge.py",
        "search_m / reference_m - 1",
        "0.0",
        "tests/test_tuning_study.py::test_the_error_of_the_step_is_measured_against_accurate_ones",
    ),
    M(
        "the judge looks at the first chunk again and again",
        "tuning/judge.py",
        "np.arange(first, min(first + AT_ONCE, count))",
        "np.arange(min(AT_ONCE, count - first))",
        "tests/test_tuning_study.py::test_the_judge_sees_every_member_of_its_own_ensemble_once",
    ),
    M(
        "the judge takes the steps of the search",
        "tuning/judge.py",
        "metrics = problem.judging.metrics(",
        "metrics = problem.engine.metrics(",
        "tests/test_tuning_study.py::test_the_judge_sees_every_member_of_its_own_ensemble_once",
    ),
    M(
        "the range of c forgets the sample period",
        "ambjax/control/search.py",
        "cap = max(1 / (5 * site.period), site.w / 10)",
        "cap = 20 * site.w",
        "tests/test_tuning_study.py::test_starts_reach_as_far_as_the_theory_suggests",
    ),
    M(
        "a range comes from a zero",
        "tuning/objective/ranges.py",
        "(STIR * float(scenario.touchdown),",
        "(0.0 * float(scenario.touchdown),",
        "tests/test_tuning_study.py::test_a_rotor_that_stands_still_has_starts_too",
    ),
    M(
        "--pareto raises",
        "tuning/command.py",
        "explore.pareto(problem, x, who)",
        "explore.pareto(problem, x)",
        "tests/test_tuning_study.py::test_pareto_is_in_the_report_and_has_a_picture",
    ),
    M(
        "--gradients raises",
        "tuning/command.py",
        "gradient.report(problem, x, who)",
        "gradient.report(problem, x)",
        "tests/test_tuning_study.py::test_gradients_reports_three_ways_to_the_same_number",
    ),
    M(
        "differences are not extrapolated as they should be",
        "tuning/report/gradient.py",
        "differences = (4 * (half_up",
        "differences = (3 * (half_up",
        "tests/test_tuning_study.py::test_gradients_reports_three_ways_to_the_same_number",
    ),
    M(
        "all points of the front have one weight",
        "tuning/search/explore.py",
        "np.geomspace(1.0, 1000.0, points - 1)",
        "1.0",
        "tests/test_tuning_study.py::test_the_front_trades_error_for_voltage",
    ),
    M(
        "slices all run along the first gain",
        "tuning/search/explore.py",
        "(j + 1) * len(REACH), j] += REACH",
        "(j + 1) * len(REACH), 0] += REACH",
        "tests/test_tuning_study.py::test_slices_run_along_each_gain_through_the_optimum",
    ),
    M(
        "the theorem's conditions weigh nothing in the descent",
        "tuning/objective/goal.py",
        "self.weight * self.penalty(x)",
        "0.0 * self.penalty(x)",
        "tests/test_tuning_study.py::test_the_theorem_s_conditions_pull_where_the_losses_are_flat",
    ),
    M(
        "no start is ever left behind",
        "tuning/search/optimise.py",
        "if count in HALVINGS:",
        "if count in ():",
        "tests/test_tuning_study.py::test_the_worse_half_of_the_starts_is_left_behind",
    ),
    M(
        "the better half of the starts is left behind",
        "tuning/search/optimise.py",
        "np.argsort(np.where(active, value, np.inf), kind",
        "np.argsort(np.where(active, -value, np.inf), kind",
        "tests/test_tuning_study.py::test_the_worse_half_of_the_starts_is_left_behind",
    ),
    M(
        "the first pair of points does not set the scale of BFGS",
        "tuning/optimisers.py",
        "jnp.where(state.seen == 1, curvature",
        "jnp.where(state.seen == -1, curvature",
        "tests/test_tuning_study.py::test_bfgs_takes_the_same_way_whatever_the_unit_of_the_loss",
    ),
    M(
        "CVaR is of the best members",
        "tuning/objective/risk.py",
        "jnp.sort(losses)[::-1]",
        "jnp.sort(losses)",
        "tests/test_tuning_space.py::test_cvar_is_the_mean_of_the_worst_share",
    ),
    M(
        "stressed members are asked to follow too",
        "tuning/objective/loss.py",
        "ordinary = 1.0 - 1.0 * stressed",
        "ordinary = 1.0 - 0.0 * stressed",
        "tests/test_tuning_search.py::test_stressed_members_hear_more_and_count_by_being_held",
    ),
    M(
        "stressed members hear no more than the others",
        "tuning/objective/members.py",
        "lambda std: std * who.loud",
        "lambda std: std * 1.0",
        "tests/test_tuning_search.py::test_stressed_members_hear_more_and_count_by_being_held",
    ),
    M(
        "survival points to gains that lose the rotor sooner",
        "tuning/objective/loss.py",
        "at = jax.lax.stop_gradient(at) + (",
        "at = jax.lax.stop_gradient(at) - (",
        "tests/test_tuning_space.py::test_survival_points_to_gains_that_keep_the_rotor_longer",
    ),
]
SAMPLED = [
    M(
        "the voltages of the two samples before change places",
        "ambjax/simulation/sampled.py",
        "past = (state.command.u, state.past[0])",
        "past = (state.past[0], state.command.u)",
        "tests/test_sampled.py::test_the_voltage_of_a_sample_acts_late",
    ),
    M(
        "the second stretch of a sample is as long as the whole",
        "ambjax/simulation/sampled.py",
        "period - stretches[0][1]",
        "period",
        "tests/test_sampled.py::test_the_voltage_of_a_sample_acts_late",
    ),
    M(
        "the laws act on the estimate of now, however late their voltage is",
        "ambjax/control/cascade.py",
        "if processor.predict:",
        "if False:",
        "tests/test_sampled.py::test_against_the_independent_simulator[two samples]",
    ),
    M(
        "the reference is that of the sample, not of the instant at which the voltage acts",
        "ambjax/simulation/sampled.py",
        "late = processor.delay * self.period if processor.predict else 0.0",
        "late = 0.0",
        "tests/test_sampled.py::test_against_the_independent_simulator[two samples]",
    ),
    M(
        "gamma bounds the change of v in a second, not in a sample",
        "ambjax/control/inversion.py",
        "inputs.v_star - relax(w, period * self.gamma, self.p)",
        "inputs.v_star - relax(w, self.gamma, self.p)",
        "tests/test_sampled.py::test_against_the_independent_simulator[half a sample]",
    ),
    M(
        "the sign on a processor is that of the step's start",
        "ambjax/numerics/relax.py",
        "return smooth_sign(relax(w, h, p), p)",
        "return smooth_sign(w, p)",
        "tests/test_relax.py::test_the_relay_is_the_limit_of_a_steep_sign",
    ),
    M(
        "a law that leaves the numbers takes the state with it",
        "ambjax/simulation/sampled.py",
        "jnp.where(sane, a, b), new",
        "jnp.where(True, a, b), new",
        "tests/test_sampled.py::test_a_law_that_gives_no_number_keeps_what_it_had",
    ),
    M(
        "the current of the lower coil falls with its gap",
        "ambjax/world/coils.py",
        "+ i_2 * z_dot * below",
        "- i_2 * z_dot * below",
        "tests/test_sampled.py::test_against_the_independent_simulator[two coils]",
    ),
]
MUTATIONS = [*PLANT, *LAWS, *LOOP, *METHODS, *NOISE, *ENSEMBLE, *SEARCH, *SAMPLED]
