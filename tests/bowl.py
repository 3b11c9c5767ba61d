"""An engine whose losses are formulas, in place of the compiled one. The result of a search is then known by hand,
and the search takes milliseconds.

A member's tracking error is least at the gains `best`; a member is lost, the earlier the further, where c is above a
limit of its own. The search's own step reports an error that is too large by a factor of its own.
"""

import dataclasses
import functools
import json
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from texts import case_and_tune
from tomlkit import dumps

from ambjax.solvers import AdaptiveRodas3
from tuning.problem.limits import PREFIX
from tuning.problem.loss import TERMS, outcomes

# Smallest tracking error, (m / s_0)^2, and the duration, s.
FLOOR, DURATION = 1e-4, 0.02
S_0 = 5e-3
# Logarithm of the last gain, relative to the best one, below which rare members have large errors.
RARE_FROM = 0.3
# Of the imaginary parts that carry derivatives, which are exact: they are never subtracted.
TINY = 1e-30


@dataclasses.dataclass
class World:
    """The true loss, and `calls`: (kind, seed, numbers of the members, points) of every call of an engine."""

    best: tuple[float, ...] = (100.0, 60.0)
    limit: Callable[[int, int, bool, bool], float] = lambda seed, number, stressed, accurate: math.inf
    """largest c (1/s) at which a member is held: by seed, number, whether it is stressed, whether steps are accurate"""
    stalls: Callable[[int, int, bool], bool] = lambda seed, number, accurate: False
    """whether the integration of a member stalls: by seed, number, and whether steps are accurate"""
    bias: Callable[[int], float] = lambda substeps: 0.0
    """relative error of the settled error, by number of substeps"""
    rare: Callable[[int, int], float] = lambda seed, number: 0.0
    """slope of the error of a member below a logarithm of -RARE_FROM of the last gain: by seed and number"""
    valley: float = math.inf
    """logarithm of the first gain, relative to `best`, of a second and lower optimum; inf: there is none"""
    chaos: float = 0.0
    """size of an error of every derivative, with a sign that changes from point to point"""
    louder: float = 1.0
    """ratio of the voltage of the final evaluation to that of the search"""
    calls: list[tuple[str, int, tuple[int, ...], int]] = dataclasses.field(default_factory=list)

    def seeds(self, kind: str) -> set[int]:
        """Seeds of the members in all calls of this kind."""
        return {seed for what, seed, *_ in self.calls if what == kind}


class Bowl:
    """An engine whose losses are formulas; `world` is set by `study`."""

    world: World

    def __init__(self, objective, *, settle, mode="forward", threads=None, lanes=64):
        self.objective, self.mode, self.threads, self.rollouts = objective, mode, threads, 0
        self.accurate = isinstance(objective.clock.method, AdaptiveRodas3)

    def _note(self, kind, x, members):
        for seed in sorted(set(np.asarray(members.seed).tolist())):
            numbers = np.asarray(members.member)[np.asarray(members.seed) == seed]
            self.world.calls.append((kind, seed, tuple(numbers.tolist()), len(x)))
        self.rollouts += len(x) * len(members.member)

    def _terms(self, x, members, along=None):
        """Terms [S, N] at coordinates x [S, m]; their derivatives along coordinate `along` as imaginary parts."""
        logs, slopes = (np.asarray(part) for part in _log_gains(self.objective.space, jnp.asarray(x) * 1.0))
        if along is not None:
            logs = logs + 1j * TINY * np.where(np.arange(x.shape[1]) == along, slopes, 0.0)
        away = logs - np.log(self.world.best)
        which = (members.seed, members.member, members.stressed)
        numbered = list(zip(*(np.asarray(one).tolist() for one in which), strict=True))
        limits = np.log([self.world.limit(*one, self.accurate) for one in numbered])
        beyond = logs[:, :1] - limits
        beyond = np.where(beyond.real > 0, beyond, 0.0)
        nothing = 0.0 * beyond
        # voltage grows with the last gain, and is a tenth of the limit where that is best
        each = {"tracking": FLOOR * (1 + (away**2).sum(axis=1)), "effort": 0.01 * np.exp(2 * away[:, -1])}
        if math.isfinite(self.world.valley):
            within = abs(away[:, 0].real - self.world.valley) < 1
            other = 0.1 * FLOOR * (1 + (away[:, 0] - self.world.valley) ** 2 + (away[:, 1:] ** 2).sum(axis=1))
            each["tracking"] = np.where(within, other, each["tracking"])
        each = {name: term[:, None] + nothing for name, term in each.items()} | {"survival": 1 - np.exp(-beyond)}
        slope = np.array([self.world.rare(*one[:2]) for one in numbered])
        below = -RARE_FROM - away[:, -1:]
        each["tracking"] = each["tracking"] + FLOOR * (slope * np.where(below.real > 0, below, 0.0)) ** 2
        terms = {name: each.get(name, nothing) for name in TERMS}
        quantities = dict.fromkeys(self.objective.loss.measures, 200 * each["effort"] ** 0.5)
        if "rms_error_m" in quantities:
            quantities["rms_error_m"] = S_0 * each["tracking"] ** 0.5
        return terms | {PREFIX + name: value for name, value in quantities.items()}

    def terms(self, x, members):
        self._note("terms", x, members)
        return self._terms(x, members)

    def metrics(self, x, members):
        self._note("metrics", x, members)
        found = self._terms(x, members)
        each = zip(np.asarray(members.seed).tolist(), np.asarray(members.member).tolist(), strict=True)
        stalled = np.array([self.world.stalls(*one, self.accurate) for one in each]) & (found["survival"] > -1)
        lost = (found["survival"] > 0) & ~stalled
        substeps = getattr(self.objective.clock.method, "substeps", None)
        bias = 0.0 if self.accurate else self.world.bias(substeps)
        error = S_0 * np.sqrt(found["tracking"]) * (1 + bias)
        numbers = np.broadcast_to(np.asarray(members.member, float), lost.shape)
        metrics = {
            "settled_rms_error_m": error,
            "settled_max_abs_error_m": 2 * error,
            "settled_rms_u_V": 200 * np.sqrt(found["effort"]) * self.world.louder,
            "chatter_V": 1 + numbers,
            "lost": lost,
            "stalled": stalled,
            "lost_at_s": np.where(lost | stalled, DURATION * (1 - found["survival"]), np.inf),
        }
        return {"loss": found, "metrics": metrics}

    def gradient(self, x, members, weights):
        self._note("gradient", x, members)
        self.rollouts += len(x) * len(members.member) * x.shape[1]
        each = np.broadcast_to(np.asarray(weights, float), (len(x), len(TERMS))).T[:, :, None]
        names = sorted(self.objective.loss.measures)
        found = [outcomes(each, self._terms(x, members, j), members.stressed, names) for j in range(x.shape[1])]
        slopes = np.stack([np.stack(one, -1).imag for one in found], -1) / TINY
        chaos = self.world.chaos * np.sign(np.sin(1e6 * np.asarray(x)))[:, None, None, :]
        return np.stack(found[0], -1).real, slopes + chaos, self._terms(x, members)


@functools.partial(jax.jit, static_argnums=0)
def _log_gains(space, x):
    """Logarithms of the gains at coordinates x [S, m], and the slope of each along its own coordinate."""
    return jax.jvp(lambda x: jnp.log(jax.vmap(space.gains_at)(x)), (x,), (jnp.ones_like(x),))


CASE = {
    "reference": {"kind": "sine", "amplitude": 1e-3, "frequency": 2.0},
    "sensor": {"std": 1e-6},
    "actuator": {"u_max": 200.0},
    "clock": {"duration": DURATION},
    "run": {"settle": 0.01},
}
PATHS = ["controller.position.c", "controller.position.k"]
BOUNDS = {"controller": {"position": {"c": [1.0, 1000.0], "k": [1.0, 1000.0]}}}
BUDGET = {
    "members": 4, "stressed": 2, "validation": 10, "held_out": 6, "screen": 0, "starts": 1, "iterations": 40
}  # fmt: skip


def document(tables=None, **tune):
    """A case file whose two gains are tuned, as read from TOML; `tables` replace those of CASE."""
    limits = {"sensitivity": math.inf} | tune.pop("limits", {})
    settings = {"objective": "least_error", "gains": PATHS, "bounds": BOUNDS, "weights": {"effort": 0.0}} | BUDGET
    return CASE | (tables or {}) | {"tune": settings | {"limits": limits} | tune}


def instead_of_engines(monkeypatch, world):
    """Replace every engine that is made from now on by a Bowl in this world, whose loops are stable."""
    import tuning.problem.tuning_problem
    import tuning.validate

    monkeypatch.setattr(tuning.validate, "_unstable", lambda course, x, numbers: numbers[:0])

    monkeypatch.setattr(Bowl, "world", world, raising=False)
    monkeypatch.setattr(tuning.problem.tuning_problem, "Engine", Bowl)


def study(monkeypatch, world, tables=None, **tune):
    """Return the tuning problem of the case in a world. Each of its engines is a Bowl."""
    import tuning.problem.tuning_problem

    instead_of_engines(monkeypatch, world)
    raw = document(tables, **tune)
    return tuning.problem.tuning_problem.problem_of(*case_and_tune(raw))


def answer_of(monkeypatch, folder, world, listen=lambda event: None, **tune):
    """The answer of the rounds of a study in a world, and its gains (c, k)."""
    from tuning.rounds import rounds

    folder.mkdir(exist_ok=True)
    made = study(monkeypatch, world, **tune)
    answer = rounds(made, made.tune.space.values(made.case.cascade), folder, {"of": str(tune)}, False, listen)
    return answer, np.asarray(answer.problem.objective.space.gains_at(answer.x))


def case_file(folder, **tune):
    """Write the case file, and return its path and that of its output folder."""
    path = folder / "case.toml"
    path.write_text(dumps(document(**tune)))
    return path, folder / "out"


def command(monkeypatch, folder, capsys, world, *flags, **tune):
    """Run `ambjax tune` without pictures in a world: exit code, facts, stdout, stderr and output folder."""
    import tuning.report.folder
    from tuning.__main__ import main

    monkeypatch.setattr(tuning.report.folder, "_pictures", lambda *_: None)
    study(monkeypatch, world, **tune)
    path, out = case_file(folder, **tune)
    code = main([str(path), "--out", str(out), *flags])
    return code, json.loads((out / "report.json").read_text()), *capsys.readouterr(), out
