"""Statistics against closed forms, simulated coverage, and independent implementations."""

import json

import numpy as np
import pytest
from scipy import stats

from ambjax.ensemble import cvar, quantile, statistics, summary, wilson
from ambjax.ensemble.intervals import WIDTH, _group_edges, bootstrap

RNG = np.random.default_rng(5)


# --- Wilson ---


@pytest.mark.parametrize("n", [1, 7, 50, 1000])
def test_wilson_solves_its_own_equation(n):
    # Wilson's limits are the p at which |share - p| = z sqrt(p (1-p)/n)
    k = np.unique(np.linspace(0, n, 9).round())
    share, low, high = wilson(k, n)
    for p in (low, high):
        np.testing.assert_allclose((share - p) ** 2, 1.959963984540054**2 * p * (1 - p) / n, rtol=1e-9, atol=1e-15)
    assert np.all((low >= 0) & (low <= share) & (share <= high) & (high <= 1))
    assert low[0] == 0
    assert high[-1] == 1


def test_wilson_agrees_with_scipy():
    for k, n, confidence in ((3, 10, 0.95), (999, 1000, 0.99), (0, 5, 0.9)):
        theirs = stats.binomtest(k, n).proportion_ci(confidence, method="wilson")
        np.testing.assert_allclose(wilson(k, n, confidence)[1:], (theirs.low, theirs.high), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("p", [0.02, 0.3, 0.9])
def test_wilson_coverage_by_simulation(p):
    # the coverage of a discrete interval swings around its nominal 95 %; within 2.5 % of it for n p >= 4
    _, low, high = wilson(RNG.binomial(200, p, size=20_000), 200)
    assert abs(np.mean((low <= p) & (p <= high)) - 0.95) < 0.025


@pytest.mark.parametrize(("k", "n"), [(1, 0), (-1, 5), (6, 5)])
def test_wilson_refuses_bad_arguments(k, n):
    with pytest.raises(ValueError, match="successes"):
        wilson(k, n)


# --- quantiles ---


@pytest.mark.parametrize("n", [1, 2, 30, 1001])
def test_a_quantile_is_the_value_of_its_rank(n):
    x, q = RNG.normal(size=n), np.array([0.05, 0.1, 0.5, 0.9, 0.95, 1.0])
    np.testing.assert_array_equal(quantile(x, q).value, np.quantile(x, q, method="inverted_cdf"))


def test_the_interval_of_a_quantile_follows_from_the_binomial_distribution():
    # the largest rank that is above the true quantile with at most 2.5 %, and the smallest below it
    for n, q in ((200, 0.95), (200, 0.5), (30, 0.05), (1001, 0.95)):
        x = np.arange(1.0, n + 1)  # a value is its rank
        _, low, high = quantile(x, q)
        above = stats.binom(n, q).cdf  # so many values or fewer lie below the true one
        if np.isfinite(low):
            assert above(low - 1) <= 0.025
        assert above(0 if np.isinf(low) else low) > 0.025
        if np.isfinite(high):
            assert 1 - above(high - 1) <= 0.025
        assert 1 - above(n - 1 if np.isinf(high) else high - 2) > 0.025


def test_the_interval_of_a_quantile_is_infinite_if_the_ensemble_is_too_small():
    # all 72 lie below the 95 % quantile with 0.95^72 = 2.49 %, all 71 with 2.62 %
    assert quantile(np.arange(71.0), 0.95).high == np.inf
    assert quantile(np.arange(72.0), 0.95).high == 71
    assert quantile(np.array([3.0]), 0.5) == (3.0, -np.inf, np.inf)


@pytest.mark.parametrize("n", [200, 1000])
def test_quantile_coverage_is_at_least_nominal(n):
    # 2,000 samples of exponentials; true quantile -log(1 - q). Exact intervals cover 95 % or more: ranks are whole;
    # a share of 2,000 trials is known to 0.5 %, three of which
    for q in (0.05, 0.5, 0.95):
        hits = [e.low <= -np.log(1 - q) <= e.high for e in (quantile(RNG.exponential(size=n), q) for _ in range(2000))]
        assert 0.95 - 0.015 < np.mean(hits) < 0.99


def test_quantiles_of_infinite_values():
    x = np.array([1.0, 2.0, 3.0, np.inf])
    assert quantile(x, 0.5).value == 2
    assert quantile(x, 1.0).value == np.inf


# --- mean, standard deviation, CVaR ---


def test_the_cvar_of_a_normal_distribution():
    # E[X | X > q] = phi(z)/(1 - alpha) = 2.0627 at 95 %
    exact = stats.norm.pdf(stats.norm.ppf(0.95)) / 0.05
    found = cvar(RNG.normal(size=200_000), 0.95, seed=1)
    # its variance is (Var[X | X > q] + 0.95 (cvar - q)^2)/(0.05 N) = 0.304/1e4: standard error 5.5e-3, five of them
    assert abs(found.value - exact) < 0.028
    assert abs((found.high - found.low) / (2 * 1.96 * 5.5e-3) - 1) < 0.15  # 1,000 resamples know it to 5 %


def test_cvar_weights_the_value_at_the_quantile():
    assert cvar(np.array([1.0, 2.0, 3.0, 4.0]), 0.5).value == 3.5
    np.testing.assert_allclose(cvar(np.array([1.0, 2.0, 3.0, 4.0]), 0.625).value, (4 + 0.5 * 3) / 1.5)
    np.testing.assert_allclose(cvar(np.array([1.0, 2.0, 6.0]), 0.0).value, 3.0)  # of everything: the mean
    assert cvar(np.full(40, 2.5)) == (2.5, 2.5, 2.5)


def test_the_bootstrap_agrees_with_explicit_resampling():
    # 400 exponentials; the oracle draws indices and has formulas of its own. Limits agree within the noise of
    # 1,000 resamples: 0.6 of a standard error (at 2.5 %, sqrt(0.025 0.975/1000) over the density there, 0.02 in the
    # long tail of t, is 0.25 of one, more than twice)
    n, x = 400, RNG.exponential(size=400)

    def measured(rows):
        tails = np.sort(rows, axis=1)[:, -20:]
        excess = np.zeros(rows.shape)
        excess[:, -20:] = tails - tails[:, :1]
        centred = rows - rows.mean(axis=1, keepdims=True)
        m2, m4 = (centred**2).mean(axis=1), (centred**4).mean(axis=1)
        return {
            "mean": (rows.mean(axis=1), np.sqrt(m2 / n)),
            "std": (np.log(np.sqrt(m2)), np.sqrt((m4 - m2**2) / n) / (2 * m2)),
            "cvar": (tails.mean(axis=1), excess.std(axis=1) / 0.05 / np.sqrt(n)),
        }

    picks, whole = measured(x[RNG.integers(n, size=(20_000, n))]), measured(x[None])
    found = bootstrap([x], 0.95, 0.95, 3)
    for kind, (values, errors) in picks.items():
        (value,), (error,) = whole[kind]
        ends = value - error * np.quantile((values - value) / errors, [0.975, 0.025])
        if kind == "std":
            ends, error = np.exp(ends) * np.sqrt(n / (n - 1)), error * x.std()
        np.testing.assert_allclose([found[kind].low[0], found[kind].high[0]], ends, atol=0.6 * error, rtol=0)
    np.testing.assert_allclose(found["mean"].value[0], x.mean(), rtol=1e-13)
    np.testing.assert_allclose(found["std"].value[0], x.std(ddof=1), rtol=1e-13)
    np.testing.assert_allclose(found["cvar"].value[0], np.sort(x)[-20:].mean(), rtol=1e-13)


TAILS = {
    "normal": (stats.norm(), ("mean", "std", "cvar")),
    "lognormal": (stats.lognorm(1), ("mean", "cvar")),  # its fourth moment is not seen in 200 values
    "bounded": (stats.beta(2, 2), ("mean", "std", "cvar")),
}


@pytest.mark.parametrize(
    ("tail", "n"),
    [
        pytest.param(tail, n, marks=pytest.mark.slow if n == 200 and tail != "bounded" else pytest.mark.thorough)
        for tail in TAILS
        for n in (200, 1000)
    ],
)
def test_coverage_over_1000_repetitions(tail, n):
    """The coverage is 95 % within three binomial standard errors, and 1 % for the error of the method.

    The standard error of 1,000 repetitions is 0.7 %.
    """
    kind, covered = TAILS[tail]
    q = kind.ppf(0.95)
    truth = {"mean": kind.mean(), "std": kind.std(), "cvar": kind.expect(lambda x: x, lb=q) / 0.05}
    rng, hits = np.random.default_rng(n), {name: [] for name in covered}
    quantiles = []
    for seed in range(10):  # so that no set of resamples serves more than 100 samples
        samples = kind.rvs(size=(100, n), random_state=rng)
        found = bootstrap(list(samples), 0.95, 0.95, seed)
        for name, hit in hits.items():
            hit += list((found[name].low <= truth[name]) & (truth[name] <= found[name].high))
        quantiles += [e.low <= q <= e.high for e in (quantile(x, 0.95) for x in samples)]
    for name, hit in hits.items():
        assert abs(np.mean(hit) - 0.95) < 0.031, (name, np.mean(hit))
    assert 0.95 - 0.021 < np.mean(quantiles) < 0.99


def test_the_interval_of_the_cvar_of_a_heavy_tail_covers_it():
    # 400 samples of 200 lognormals: a share known to 1.2 %, three of which below 94 %. Percentile intervals cover 83 %
    truth, hits = np.exp(0.5) * stats.norm.cdf(1 - stats.norm.ppf(0.95)) / 0.05, []
    for seed in range(8):
        found = bootstrap(list(np.random.default_rng(seed).lognormal(size=(50, 200))), 0.95, 0.95, seed)["cvar"]
        hits += list((found.low <= truth) & (truth <= found.high))
    assert np.mean(hits) > 0.94 - 0.036


@pytest.mark.parametrize("n", [50, 200])
def test_the_interval_of_a_cvar_ends_at_most_at_the_largest_value(n):
    """The interval also covers the true value.

    The standard error of the coverage over 400 samples is 1.1 %; the tolerance is three of them. For 50 values, the
    upper end may be infinite.
    """
    samples = np.random.default_rng(n).normal(size=(400, n))
    found, largest = bootstrap(list(samples), 0.95, 0.95, 1)["cvar"], samples.max(axis=1)
    assert np.all((found.high <= largest) | np.isinf(found.high))
    assert np.any(np.isinf(found.high)) == (n < 200)
    truth = stats.norm.pdf(stats.norm.ppf(0.95)) / 0.05
    assert np.mean((found.low <= truth) & (truth <= found.high)) > 0.95 - 0.033
    # the end would not be true otherwise: the CVaR of 37 % of such samples of 50 lies above their largest value
    assert abs(np.mean(truth > largest) - stats.norm.cdf(truth) ** n) < 0.075


def test_the_interval_of_a_constant_tail_has_zero_width():
    # a tenth of the members at the clearance: so are the worst 5 % of nearly every resample
    found = bootstrap([np.where(np.arange(500) < 50, 4.5e-3, 1e-6 * RNG.random(500))])["cvar"]
    np.testing.assert_allclose([found.low[0], found.value[0], found.high[0]], 4.5e-3, rtol=1e-12)  # rounding of a scale


def test_the_interval_is_infinite_if_the_resamples_do_not_determine_it():
    for moments in bootstrap([np.array([1.0, 2.0, 4.0])]).values():
        assert np.all(moments.low <= moments.value)
        assert moments.high[0] == np.inf  # one resample in nine is one value thrice
    assert summary(columns(201), [], seed=0)["notes"] == [  # two of whom do not survive
        "the worst 5 % are 9.95 survivors: the 95 % interval of their mean may have a lower coverage or no upper end; "
        "use at least 200 survivors"
    ]
    assert summary(columns(202), [], seed=0)["notes"] == []


def test_a_note_states_the_coverage_of_the_std_of_a_heavy_tail():
    rng = np.random.default_rng(2)
    data = columns(1200) | {"rms_u_V": rng.lognormal(size=1200), "max_abs_u_V": np.full(1200, 200.0)}
    assert summary(data, [], seed=0)["notes"] == [
        "heavy tails (rms_u_V): the interval of a standard deviation is too short; a 95 % interval covers 90 % for "
        "lognormal values of 1,000 members"
    ]
    few = summary({k: x[:30] for k, x in data.items()} | {"rms_u_V": np.eye(30)[0]}, [], seed=0)["notes"]
    assert len(few) == 2
    assert "covers 83 % for lognormal values of 50 members" in few[1]
    many = summary(data | {f"m{k}": data["rms_u_V"] for k in range(4)}, [], seed=0)["notes"]
    assert "(rms_u_V, m0, m1 and 2 more)" in many[0]
    # an exponential's own, of more members than its fourth moment wants; and a kurtosis does not know its scale
    assert statistics._kurtosis(1e-200 * rng.exponential(size=1_000_000)) == pytest.approx(9.0, rel=0.1)
    assert statistics._kurtosis(np.array([-1.0, 1.0])) == 1.0


@pytest.mark.parametrize(
    "n", [pytest.param(n, marks=pytest.mark.slow if n == 50 else pytest.mark.thorough) for n in (50, 200, 1000)]
)
def test_the_std_of_a_heavy_tail_has_the_stated_coverage(n):
    # 2,000 ensembles: a share known to 0.8 %, three of which
    true, hits = stats.lognorm(1).std(), []
    for seed in range(20):
        found = bootstrap(list(np.random.default_rng((n, seed)).lognormal(size=(100, n))), 0.95, 0.95, seed)["std"]
        hits += list((found.low <= true) & (true <= found.high))
    assert abs(np.mean(hits) - statistics.COVERED[n] / 100) < 0.024


def test_groups_contain_every_rank_once_and_are_few():
    for n in (1, 2, 3, 1000, 2048, 10**6):
        edges = _group_edges(n)
        assert edges[0] == 0
        assert edges[-1] == n
        sizes = np.diff(edges)
        assert np.all(sizes >= 1)
        middle = np.minimum(edges[1:], n - edges[:-1])
        assert np.all(sizes <= np.maximum(middle / WIDTH, 1))
        assert n > 2048 or np.all(sizes == 1)
        assert len(sizes) <= max(2048, 1024 * (2.4 + np.log(n / 2048)))


def test_grouped_intervals_have_the_width_of_the_central_limit_theorem():
    # 1e5 values in 6,000 groups: the same widths as if each value were resampled, to the 5 % of 1,000 resamples, thrice
    x = RNG.normal(size=100_000)
    found = bootstrap([x, 1e6 + 1e-3 * x], seed=1)
    for kind, deviation in (("mean", 1.0), ("std", 0.5**0.5)):
        width = found[kind].high - found[kind].low
        np.testing.assert_allclose(width / (2 * 1.96 * deviation / 100_000**0.5), [1, 1e-3], rtol=0.15)


def test_the_same_seed_gives_the_same_interval():
    x = RNG.normal(size=200)
    assert cvar(x, seed=4) == cvar(x[::-1], seed=4)
    assert cvar(x, seed=4) != cvar(x, seed=5)


@pytest.mark.parametrize("values", [[], [1.0, np.nan], [[1.0]], [1.0, np.inf]])
def test_cvar_refuses_what_is_not_a_column_of_numbers(values):
    with pytest.raises(ValueError, match="column"):
        cvar(np.array(values))


def test_cvar_refuses_an_alpha_outside_0_to_1():
    with pytest.raises(ValueError, match="alpha"):
        cvar(np.ones(3), 1.0)


# --- the summary ---


def columns(n=200):
    rng = np.random.default_rng(1)
    mass, phase = rng.normal(size=n), rng.random(n)
    lost_at = np.full(n, np.inf)
    lost_at[[7, 3]] = [0.2, 0.1]
    return {
        "index": np.arange(100, 100 + n),
        "lost_at": lost_at,
        "lost": np.isfinite(lost_at) & (np.arange(n) != 7),
        "stalled": np.arange(n) == 7,
        "lost_at_s": lost_at,
        "settled_max_abs_error_m": 1e-6 * (5 + mass + 0.1 * rng.normal(size=n)),
        "sigma_reached_s": np.where(np.arange(n) < 5, np.inf, 0.1),
        "spread.plant.m": mass,
        "spread.disturbance.q_z.phase": phase,
    }


def test_the_summary_contains_the_documented_numbers():
    data, names = columns(), ["plant.m", "disturbance.q_z.phase"]
    found = summary(data, names, seed=3)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert (found["members"], found["survivors"], found["seed"]) == (200, 198, 3)
    assert (found["lost"], found["stalled"]) == (1, 1)
    share, low, high = wilson(198, 200)
    assert found["survival"] == {"estimate": share, "low": low, "high": high}
    assert set(found["metrics"]) == {"settled_max_abs_error_m", "sigma_reached_s"}
    held = np.isinf(data["lost_at"])
    error, x = found["metrics"]["settled_max_abs_error_m"], data["settled_max_abs_error_m"][held]
    np.testing.assert_allclose(error["mean"]["estimate"], x.mean(), rtol=1e-12)
    np.testing.assert_allclose(error["std"]["estimate"], x.std(ddof=1), rtol=1e-12)
    assert error["median"]["estimate"] == np.quantile(x, 0.5, method="inverted_cdf")
    assert error["max"] == x.max()
    assert error["cvar_95"] == dict(zip(("estimate", "low", "high"), map(float, cvar(x, seed=3)), strict=True))
    for kind in ("mean", "std", "median", "q05", "q95", "cvar_95"):
        assert error[kind]["low"] <= error[kind]["estimate"] <= error[kind]["high"]


def test_the_summary_of_a_time_that_is_infinite_for_some_members():
    found = summary(columns(), ["plant.m"], seed=0)["metrics"]["sigma_reached_s"]
    assert found["finite"] == 194  # of 198 survivors, 4 never reach it
    assert found["max"] is None
    assert set(found["mean"].values()) == set(found["cvar_95"].values()) == {None}
    assert found["median"] == {"estimate": 0.1, "low": 0.1, "high": 0.1}


def test_the_summary_names_the_drivers_and_the_worst_members():
    data = columns()
    found = summary(data, ["disturbance.q_z.phase", "plant.m"], seed=0, worst=4)
    first, second = found["drivers"]["settled_max_abs_error_m"]
    assert first["path"] == "plant.m"
    assert first["rho"] > 0.95
    assert first["low"] <= first["share"] <= first["high"]
    assert first["share"] > 0.9
    assert first["p"] < 1e-6 < second["p"]
    assert found["explained"]["settled_max_abs_error_m"]["alone"] > 0.9
    assert set(found["drivers"]) == {"settled_max_abs_error_m", "sigma_reached_s", "lost_at_s"}
    alone = np.isinf(data["lost_at"])
    rank = stats.spearmanr(data["spread.plant.m"][alone], data["settled_max_abs_error_m"][alone])
    assert first["rho"] == pytest.approx(rank.statistic, rel=1e-12)
    by_error = 100 + np.argsort(-data["settled_max_abs_error_m"])
    rest = [k for k in by_error if k not in (103, 107)]
    assert [member["index"] for member in found["worst"]] == [103, 107, *rest[:2]]
    assert [member["lost_at_s"] for member in found["worst"]] == [0.1, 0.2, None, None]
    assert [member["status"] for member in found["worst"]] == ["lost", "stalled", "survives", "survives"]
    assert found["worst"][2]["settled_max_abs_error_m"] == data["settled_max_abs_error_m"].max()


def test_lost_members_are_excluded_from_every_metric():
    """The voltage of a lost rotor is 0 after the loss.

    The mean over all members would therefore be below that of any survivor.
    """
    data = columns()
    ended = np.isfinite(data["lost_at"])
    data["settled_rms_u_V"] = np.where(ended, 0.0, 60.0 + data["spread.plant.m"])
    found = summary(data, ["plant.m"], seed=3)
    assert found["metrics_of"] == "survivors"
    voltage = found["metrics"]["settled_rms_u_V"]
    alone = data["settled_rms_u_V"][~ended]
    assert voltage["mean"]["estimate"] == pytest.approx(alone.mean(), rel=1e-12)
    assert voltage["q05"]["estimate"] == np.quantile(alone, 0.05, method="inverted_cdf")
    assert (voltage["max"], voltage["finite"]) == (alone.max(), 198)
    # as if the lost ones had not been simulated
    less = summary({name: x[~ended] for name, x in data.items()}, ["plant.m"], seed=3)
    assert less["metrics"] == found["metrics"]
    assert {k: v for k, v in less["drivers"].items() if k != "lost_at_s"} == {
        k: v for k, v in found["drivers"].items() if k != "lost_at_s"
    }


def test_without_survivors_the_summary_has_no_metrics():
    data = columns() | {"lost_at": np.full(200, 0.1)}
    found = summary(data, ["plant.m"], seed=0)
    assert json.dumps(found, allow_nan=False)
    assert found["survivors"] == 0
    for metric in found["metrics"].values():
        assert metric.pop("finite") == 0
        assert metric.pop("max") is None
        assert {x for estimate in metric.values() for x in estimate.values()} == {None}
    assert found["explained"]["settled_max_abs_error_m"]["says"] == "no member survives"
    assert found["notes"] == ["no member survives: there are no statistics of the metrics"]


def test_summary_without_spreads_or_with_one_member():
    one = {name: x[:1] for name, x in columns().items()}
    found = summary(one, [], seed=0)
    assert json.dumps(found, allow_nan=False)
    assert found["drivers"]["lost_at_s"] == []
    assert found["metrics"]["settled_max_abs_error_m"]["std"]["estimate"] == 0


def test_the_summary_refuses_columns_without_the_deciding_metric():
    with pytest.raises(ValueError, match="no metric rms"):
        summary(columns(), [], seed=0, deciding="rms")
