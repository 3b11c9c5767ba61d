"""Statistics against closed forms, simulated coverage, and independent implementations."""

import json

import numpy as np
import pytest
from scipy import stats

from ambjax.ensemble import cvar, quantile, spearman, summary, wilson
from ambjax.ensemble.statistics import WIDTH, _group_edges, bootstrap

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


def test_wilson_is_scipy_s():
    for k, n, confidence in ((3, 10, 0.95), (999, 1000, 0.99), (0, 5, 0.9)):
        theirs = stats.binomtest(k, n).proportion_ci(confidence, method="wilson")
        np.testing.assert_allclose(wilson(k, n, confidence)[1:], (theirs.low, theirs.high), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("p", [0.02, 0.3, 0.9])
def test_wilson_coverage_by_simulation(p):
    # the coverage of a discrete interval swings around its nominal 95 %; within 2.5 % of it for n p >= 4
    _, low, high = wilson(RNG.binomial(200, p, size=20_000), 200)
    assert abs(np.mean((low <= p) & (p <= high)) - 0.95) < 0.025


@pytest.mark.parametrize(("k", "n"), [(1, 0), (-1, 5), (6, 5)])
def test_wilson_refuses(k, n):
    with pytest.raises(ValueError, match="successes"):
        wilson(k, n)


# --- quantiles ---


@pytest.mark.parametrize("n", [1, 2, 30, 1001])
def test_quantile_is_the_value_of_its_rank(n):
    x, q = RNG.normal(size=n), np.array([0.05, 0.1, 0.5, 0.9, 0.95, 1.0])
    np.testing.assert_array_equal(quantile(x, q).value, np.quantile(x, q, method="inverted_cdf"))


def test_quantile_interval_is_that_of_explicit_resampling():
    x = np.sort(RNG.exponential(size=80))
    picks = np.sort(x[RNG.integers(80, size=(40_000, 80))], axis=1)[:, 71]  # rank ceil(0.9 * 80)
    ends = np.searchsorted(x, np.quantile(picks, [0.025, 0.975]))
    # one rank apart at most: 40,000 resamples know a probability of 2.5 % to 0.08 %, a rank's is 2 to 4 %
    found = np.searchsorted(x, quantile(x, 0.9)[1:])
    assert np.all(np.abs(found - ends) <= 1)


def test_quantile_coverage_is_nominal():
    # 2,000 samples of 200 exponentials; true quantile -log(1 - q). Discreteness at rank 190 of 200 costs up to 2 %
    for q in (0.5, 0.95):
        hits = [
            e.low <= -np.log(1 - q) <= e.high for e in (quantile(RNG.exponential(size=200), q) for _ in range(2000))
        ]
        assert abs(np.mean(hits) - 0.95) < 0.03


def test_quantiles_of_what_is_never_reached():
    x = np.array([1.0, 2.0, 3.0, np.inf])
    assert quantile(x, 0.5).value == 2
    assert quantile(x, 1.0).value == np.inf


# --- mean, standard deviation, CVaR ---


def test_cvar_of_a_normal():
    # E[X | X > q] = phi(z)/(1 - alpha) = 2.0627 at 95 %
    exact = stats.norm.pdf(stats.norm.ppf(0.95)) / 0.05
    found = cvar(RNG.normal(size=200_000), 0.95, seed=1)
    # its variance is (Var[X | X > q] + 0.95 (cvar - q)^2)/(0.05 N) = 0.304/1e4: standard error 5.5e-3, five of them
    assert abs(found.value - exact) < 0.028
    assert abs((found.high - found.low) / (2 * 1.96 * 5.5e-3) - 1) < 0.1  # 1,000 resamples know a spread to 5 %


def test_cvar_counts_the_value_at_the_edge_in_part():
    assert cvar(np.array([1.0, 2.0, 3.0, 4.0]), 0.5).value == 3.5
    np.testing.assert_allclose(cvar(np.array([1.0, 2.0, 3.0, 4.0]), 0.625).value, (4 + 0.5 * 3) / 1.5)
    np.testing.assert_allclose(cvar(np.array([1.0, 2.0, 6.0]), 0.0).value, 3.0)  # of everything: the mean
    assert cvar(np.full(7, 2.5)) == (2.5, 2.5, 2.5)


def test_bootstrap_is_explicit_resampling():
    # 400 lognormals; the oracle draws indices. Limits agree within the noise of 1,000 resamples: 0.25 of a
    # standard error (at 2.5 %, sqrt(0.025 0.975/1000)/0.0584 = 0.085 of one, times three)
    x = RNG.lognormal(size=400)
    picks = x[RNG.integers(400, size=(20_000, 400))]
    oracle = {
        "mean": picks.mean(axis=1),
        "std": picks.std(axis=1, ddof=1),
        "cvar": np.sort(picks, axis=1)[:, -20:].mean(axis=1),
    }
    found = bootstrap([x], 0.95, 0.95, 3)
    for kind, replicates in oracle.items():
        ends = np.quantile(replicates, [0.025, 0.975])
        np.testing.assert_allclose(
            [found[kind].low[0], found[kind].high[0]], ends, atol=0.25 * replicates.std(), rtol=0
        )
    np.testing.assert_allclose(found["mean"].value[0], x.mean(), rtol=1e-13)
    np.testing.assert_allclose(found["std"].value[0], x.std(ddof=1), rtol=1e-13)
    np.testing.assert_allclose(found["cvar"].value[0], np.sort(x)[-20:].mean(), rtol=1e-13)


def test_bootstrap_coverage_is_roughly_nominal():
    # 1,000 samples of 500 normals, resampled alike. Percentile intervals of a tail of 25 values are known to be
    # short: 90 to 95 % (Efron and Tibshirani, section 14); of mean and deviation 94 to 95 %
    samples = list(RNG.normal(size=(1000, 500)))
    found = bootstrap(samples, 0.95, 0.95, 0)
    truth = {"mean": 0.0, "std": 1.0, "cvar": stats.norm.pdf(stats.norm.ppf(0.95)) / 0.05}
    for kind, lowest in (("mean", 0.925), ("std", 0.915), ("cvar", 0.87)):
        share = np.mean((found[kind].low <= truth[kind]) & (truth[kind] <= found[kind].high))
        assert lowest < share < 0.975, kind


def test_groups_cover_every_rank_once_and_stay_few():
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
    x = RNG.normal(size=50)
    assert cvar(x, seed=4) == cvar(x[::-1], seed=4)
    assert cvar(x, seed=4) != cvar(x, seed=5)


@pytest.mark.parametrize("values", [[], [1.0, np.nan], [[1.0]], [1.0, np.inf]])
def test_cvar_refuses_what_has_none(values):
    with pytest.raises(ValueError, match="column"):
        cvar(np.array(values))


def test_cvar_refuses_an_alpha_that_is_no_share():
    with pytest.raises(ValueError, match="alpha"):
        cvar(np.ones(3), 1.0)


# --- rank correlation ---


@pytest.mark.parametrize("n", [3, 10, 500])
def test_spearman_is_scipy_s_ties_included(n):
    x = [RNG.normal(size=n), RNG.integers(3, size=n), np.arange(n)]
    y = [x[0] ** 3 + RNG.normal(size=n), np.exp(x[2] / n), np.where(RNG.random(n) < 0.3, np.inf, x[2])]
    rho, p = spearman(x, y)
    for a in range(3):
        for b in range(3):
            if np.ptp(x[a]) == 0:
                continue
            theirs = stats.spearmanr(x[a], np.where(np.isinf(y[b]), 1e9, y[b]))
            if np.isnan(theirs.statistic):
                continue
            np.testing.assert_allclose(rho[a, b], theirs.statistic, rtol=0, atol=1e-12)
            # near rho = 1 the p-value is that of a rounding error
            np.testing.assert_allclose(p[a, b], theirs.pvalue, rtol=1e-6, atol=1e-6)


def test_spearman_of_constants_and_of_few_members():
    rho, p = spearman([np.ones(9), np.arange(9)], [np.arange(9.0), np.full(9, np.inf)])
    np.testing.assert_allclose(rho, [[0, 0], [1, 0]], atol=1e-15)
    np.testing.assert_allclose(p, [[1, 1], [0, 1]], atol=1e-12)
    rho, p = spearman([np.array([1.0, 2.0])], [np.array([5.0, 3.0])])
    assert p == 1
    np.testing.assert_allclose(rho, -1)
    rho, p = spearman([np.ones(1)], [np.ones(1)])
    assert rho == 0
    assert p == 1


# --- the summary ---


def columns(n=200):
    rng = np.random.default_rng(1)
    mass, phase = rng.normal(size=n), rng.random(n)
    lost_at = np.full(n, np.inf)
    lost_at[[7, 3]] = [0.2, 0.1]
    return {
        "index": np.arange(100, 100 + n),
        "lost_at": lost_at,
        "lost": np.isfinite(lost_at),
        "lost_at_s": lost_at,
        "settled_max_abs_error_m": 1e-6 * (5 + mass + 0.1 * rng.normal(size=n)),
        "sigma_reached_s": np.where(np.arange(n) < 5, np.inf, 0.1),
        "spread.plant.m": mass,
        "spread.disturbance.q_z.phase": phase,
    }


def test_summary_says_what_it_promises():
    data, names = columns(), ["plant.m", "disturbance.q_z.phase"]
    found = summary(data, names, seed=3)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert (found["members"], found["survivors"], found["seed"]) == (200, 198, 3)
    share, low, high = wilson(198, 200)
    assert found["survival"] == {"estimate": share, "low": low, "high": high}
    assert set(found["metrics"]) == {"settled_max_abs_error_m", "sigma_reached_s"}
    error, x = found["metrics"]["settled_max_abs_error_m"], data["settled_max_abs_error_m"]
    np.testing.assert_allclose(error["mean"]["estimate"], x.mean(), rtol=1e-12)
    np.testing.assert_allclose(error["std"]["estimate"], x.std(ddof=1), rtol=1e-12)
    assert error["median"]["estimate"] == np.quantile(x, 0.5, method="inverted_cdf")
    assert error["max"] == x.max()
    assert error["cvar_95"] == dict(zip(("estimate", "low", "high"), map(float, cvar(x, seed=3)), strict=True))
    for kind in ("mean", "std", "median", "q05", "q95", "cvar_95"):
        assert error[kind]["low"] <= error[kind]["estimate"] <= error[kind]["high"]


def test_summary_of_a_time_that_some_never_reach():
    found = summary(columns(), ["plant.m"], seed=0)["metrics"]["sigma_reached_s"]
    assert found["finite"] == 195
    assert found["max"] is None
    assert set(found["mean"].values()) == set(found["cvar_95"].values()) == {None}
    assert found["median"] == {"estimate": 0.1, "low": 0.1, "high": 0.1}


def test_summary_names_the_drivers_and_the_worst():
    data = columns()
    found = summary(data, ["disturbance.q_z.phase", "plant.m"], seed=0, worst=4)
    first, second = found["drivers"]["settled_max_abs_error_m"]
    assert first["path"] == "plant.m"
    assert first["rho"] > 0.95
    assert first["p"] < 1e-6 < second["p"]
    assert set(found["drivers"]) == {"settled_max_abs_error_m", "sigma_reached_s", "lost_at_s"}
    by_error = 100 + np.argsort(-data["settled_max_abs_error_m"])
    rest = [k for k in by_error if k not in (103, 107)]
    assert [member["index"] for member in found["worst"]] == [103, 107, *rest[:2]]
    assert [member["lost_at_s"] for member in found["worst"]] == [0.1, 0.2, None, None]
    assert found["worst"][2]["settled_max_abs_error_m"] == data["settled_max_abs_error_m"].max()


def test_summary_without_spreads_or_with_one_member():
    one = {name: x[:1] for name, x in columns().items()}
    found = summary(one, [], seed=0)
    assert json.dumps(found, allow_nan=False)
    assert found["drivers"]["lost_at_s"] == []
    assert found["metrics"]["settled_max_abs_error_m"]["std"]["estimate"] == 0


def test_summary_refuses_columns_that_lack_the_deciding_metric():
    with pytest.raises(ValueError, match="no metric rms"):
        summary(columns(), [], seed=0, deciding="rms")
