"""Exit code, log, report, JSON and tuned.toml agree for each kind of outcome."""

import math
import re
import types

import numpy as np
import pytest
from bowl import World, command

import tuning.command
import tuning.report.folder
import tuning.rounds
from ambjax.cases.tune_table import Budget
from ambjax.control.cascade import Cascade
from ambjax.linear import Findings
from ambjax.text.web_page import escape_markdown
from tuning.judge.evaluate import summarise
from tuning.problem.config import seeds
from tuning.problem.limits import Limit
from tuning.problem.space import Gain, Space, tunable
from tuning.report import judging
from tuning.report.limit_table import BROKEN, EMPHASISED, HELD, UNJUDGED, UNVERIFIED
from tuning.report.outcome import ALL_MET, NO_HELD_OUT, NOT_MET, TuningOutcome, remedies

HELD_OUT = seeds(Budget())[2]


def losing(*numbers, accurate=False):
    """Return a world in which these held-out members are lost; with `accurate`, only with accurate steps."""
    return World(
        limit=lambda seed, number, _, fine: (
            40.0 if seed == HELD_OUT and number in numbers and (fine or not accurate) else math.inf
        )
    )


# For each outcome: the world, [tune], and the expected verdicts: on survival, on the limit of the voltage, and whether
# the gains meet all requirements. The voltage of a Bowl is 0.33 V at the lower bound of k.
OUTCOMES = {
    "held": (World, {}, HELD, HELD, True),
    "at its limit": (World, {"limits": {"rms_u_V": 10.0}}, HELD, HELD, True),
    "lost": (lambda: losing(2), {}, BROKEN, HELD, False),
    "lost, as may be": (lambda: losing(2), {"limits": {"survival": 0.8}}, HELD, HELD, True),
    "not decided": (lambda: World(stalls=lambda s, n, _: (s, n) == (HELD_OUT, 2)), {}, BROKEN, HELD, False),
    "lost and not decided": (
        lambda: World(limit=losing(2).limit, stalls=lambda s, n, _: (s, n) == (HELD_OUT, 3)),
        {"limits": {"survival": 0.8}}, BROKEN, HELD, False,
    ),
    "a limit not met": (World, {"limits": {"rms_u_V": 0.2}}, HELD, BROKEN, False),
    "not verified": (lambda: losing(1, accurate=True), {}, UNVERIFIED, UNVERIFIED, False),
    "lost and not verified": (
        lambda: World(limit=lambda s, n, _, f: 40.0 if s == HELD_OUT and (n == 2 or (n == 1 and f)) else math.inf),
        {}, BROKEN, UNVERIFIED, False,
    ),
    "every one lost": (lambda: losing(*range(6)), {"risk": "cvar"}, BROKEN, BROKEN, False),
    "no held-out members": (World, {"held_out": 0}, UNJUDGED, UNJUDGED, True),
}  # fmt: skip


@pytest.fixture
def ran(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(tuning.rounds, "MOST_ROUNDS", 1)
    return lambda world, tune: command(monkeypatch, tmp_path, capsys, world, "--force", **tune)


@pytest.mark.parametrize("kind", OUTCOMES)
def test_all_outputs_give_the_same_verdict(kind, ran):
    world, tune, survival, limit, good = OUTCOMES[kind]
    code, facts, out, err, folder = ran(world(), tune)
    # the fact
    outcome, rows = facts["outcome"], {row["name"]: row for row in facts["limits"]}
    assert (rows["survival"]["verdict"], rows["rms_u_V"]["verdict"]) == (survival, limit)
    assert outcome["limits"] == {name: row["verdict"] for name, row in rows.items()}
    assert [outcome["good"], code] == [good, int(not good)]
    for row in rows.values():
        assert row["held"] == {HELD: True, BROKEN: False}.get(row["verdict"])
    priced = [name for name, row in rows.items() if row["price"]]
    assert priced == ["rms_u_V"] * (kind == "at its limit")
    if priced:
        assert rows["rms_u_V"]["reached"] == pytest.approx(facts["after"]["settled_rms_u_V.mean"])
    assert facts["verified"] == (not facts["refuted"])
    # its words
    words = facts["verdict"]
    assert words.startswith(ALL_MET) == (good and survival == HELD)
    assert words.startswith(NO_HELD_OUT) == (survival == UNJUDGED)
    assert ("a limit 10 % higher would reduce the settled rms error by about" in words) == bool(priced)
    assert words.startswith(NOT_MET) == (not good)
    for name, row in rows.items():
        assert (f"tune.limits.{name} is {BROKEN}" in words) == (row["verdict"] == BROKEN)
    assert ("NOT VERIFIED" in words) == (UNVERIFIED in outcome["against"]) == bool(facts["refuted"])
    assert (UNJUDGED in outcome["limits"].values()) == (f"limits {UNJUDGED}: rms_u_V, survival" in words)
    # where they stand
    text = (folder / "report.md").read_text()
    first, sizes, _, limited, after_that = text.splitlines()[4:9]
    assert first.startswith("- **Held:**") == (survival != BROKEN and not facts["refuted"])
    assert first.startswith("- **NOT held:**") == (not outcome["rotors_held"])
    assert text.splitlines()[2] == escape_markdown(outcome["text"])
    for line in (first, sizes, limited):
        assert re.sub(r"\\(?=[\W_])|\*\*", "", line.removeprefix("- ")) in words
    assert (f"{facts['after'].get('settled_rms_error_m', math.nan):.3g} m" in sizes) == (facts["after"]["held"] > 0)
    assert ("NOT HELD" in limited) == (BROKEN in (survival, limit))
    assert after_that == f"- **Next:** in this folder, {facts['next']}" if good else "Next" in after_that
    assert words in (folder / "tuned.toml").read_text()
    assert words in out
    assert bool(facts["advice"]) == (not good)
    assert facts["advice"] in err
    table = dict(re.findall(r"^\| `(\w+)` \| at (?:most|least) [^|]*\|[^|]*\|[^|]*\| ([^|]*) \|", text, re.MULTILINE))
    assert table == {
        name: f"**{r['verdict']}**" if r["verdict"] in EMPHASISED else r["verdict"] for name, r in rows.items()
    }
    after, advice = facts["after"], facts["advice"]
    assert ("risk = 'cvar'" in advice) == ("Rotors are lost: " in advice and "risk" not in tune)
    assert ("Rotors are lost: " in advice) == (survival == BROKEN and after["lost"] > 0)
    assert (f"Not decided: {after['stalled']} held-out members" in advice) == (after["stalled"] > 0)
    assert (f"{after['stalled']} not decided (their integration stalls)" in words) == (after["stalled"] > 0)
    assert ("tune.limits.rms_u_V" in advice) == (limit == BROKEN)
    assert "tune.limits.survival" not in advice
    # and no message before the end states a result
    assert not re.search(r"cannot be held|is held|not held", err.replace(facts["advice"], ""), re.IGNORECASE)


def test_members_that_are_held_but_not_stable_are_told_everywhere(ran, monkeypatch):
    found = Findings(6, 2, 0.25, 1e-4, 3.0)
    monkeypatch.setattr(judging, "_stability", lambda *_: found._asdict())
    code, facts, out, err, folder = ran(World(), {})
    assert (code, facts["stability"]) == (1, found._asdict())
    assert [facts["outcome"][name] for name in ("good", "unstable", "rotors_held")] == [False, 2, True]
    limited = TuningOutcome(6, 0, 0, 0, {"sensitivity": HELD}, "", 6, 2)  # advice does not name what the case has
    of = types.SimpleNamespace(stability=found._asdict())
    assert remedies(None, of, limited, None, None).endswith("Add tune.limits.delay_margin_s.")
    assert facts["verdict"].startswith(f"{NOT_MET} 2 of 6 members tested held, but not stable")
    for text in (facts["verdict"], facts["advice"], out, err, (folder / "tuned.toml").read_text()):
        assert re.search(r"2 of 6 members tested are held, but NOT stable.*0\.0001 m, .i. up to 3 A \(bias", text)
    assert ALL_MET not in (folder / "report.md").read_text()


def test_the_advice_names_the_gains_that_are_not_tuned():
    broken, cascade = TuningOutcome(6, 0, 0, 0, {"rms_u_V": BROKEN}, "", 6, 0), Cascade()
    first, *rest = tunable(cascade)
    for paths, words in (([first, *rest], "widen tune.bounds,"), (rest, f"tune also {first},")):
        space = Space(tuple(Gain(path, 0.0, math.inf) for path in paths))
        problem = types.SimpleNamespace(
            tune=types.SimpleNamespace(space=space), case=types.SimpleNamespace(cascade=cascade)
        )
        assert f"Not held: tune.limits.rms_u_V. Loosen these limits, {words}" in remedies(
            problem, None, broken, None, None
        )


def test_the_voltage_of_a_lost_member_is_excluded_from_the_limits():
    """A lost rotor is frozen at 0 V: the mean square over all members would be half of that over the survivors."""
    columns = {"settled_rms_u_V": np.array([100.0, 0.0]), "lost_at_s": np.array([np.inf, 0.1])}
    columns |= {"lost": np.array([False, True]), "stalled": np.zeros(2, bool)}
    columns |= {"settled_rms_error_m": np.array([1e-6, 4e-3]), "settled_max_abs_error_m": np.array([2e-6, 5e-3])}
    assert Limit("rms_u_V", 80.0).reached(columns) == pytest.approx(100.0)
    summary = summarise(columns)
    assert (summary["held"], summary["lost"]) == (1, 1)
    assert summary["settled_rms_u_V.mean"] == 100.0
    assert (summary["settled_rms_error_m"], summary["settled_max_abs_error_m"]) == (1e-6, 2e-6)
    assert summary["lost_at_s.mean"] == 0.1
    no_held = summarise({name: x[1:] for name, x in columns.items()})
    assert (no_held["held"], "settled_rms_error_m" in no_held) == (0, False)
