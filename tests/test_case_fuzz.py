"""Case files near valid ones, hundreds or thousands: each is refused in one line that names the file, or it runs."""

import copy
import dataclasses
import math

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from profiles import examples
from tomlkit import dumps

from ambjax import simulate
from ambjax.cases.controller_tables import KINDS
from ambjax.cases.reader import TABLES, read_case
from ambjax.cases.scenario_tables import SIGNALS
from ambjax.cases.timing import DURATION, METHODS
from ambjax.cases.tune_table import NUMBERS as TUNED
from ambjax.cases.warned import warnings_of
from ambjax.ensemble.design import DESIGNS
from ambjax.ensemble.paths import places
from ambjax.ensemble.spread import draw
from ambjax.simulation.clock import Clock
from ambjax.world.amplifier import Amplifier
from ambjax.world.plant import Plant
from ambjax.world.scenario import Initial, Scenario
from ambjax.world.sensor import Sensor
from tuning.problem.config import read_tune
from tuning.problem.loss import TERMS
from tuning.problem.quantities import KINDS as LIMITS

# Every run is of so few samples, and of so few structures, each of which is compiled once.
SAMPLES, MOST_STRUCTURES = 4, examples(2, 12)
# Of the cases that are read, one in so many is run.
ONE_IN = 4
FIELDS = {field.name: field for kind in (Scenario, Clock) for field in dataclasses.fields(kind)}
DEEP = [0]
for _ in range(40):
    DEEP = [DEEP]
NUMBERS = [math.nan, math.inf, -math.inf, 0, -0.0, -1, 5e-324, 1e-110, 1e-300, 1e200, 1e308, -1e308, True, False]
WHOLE = [10**30, -(10**400), 10**400, 2**63, 2**32]
WORDS = ["", "auto", "1.0", "a\nb", "\x7f<b>|", "x" * 300]
NESTED = [[], [1.0], [1.0, 2.0], ["a", 1], [[[]]], DEEP, {}, {"kind": "sine"}, {"percent": 1e308}]
SPREADS = [{"log-uniform": [1e-200, 1e200]}, {"uniform": [-1e308, 1e308]}, {"normal": 5e-324}]
HOSTILE = st.one_of(
    st.sampled_from([*NUMBERS, *WHOLE, *WORDS, *NESTED, *SPREADS]), st.floats(), st.integers(), st.text(max_size=5)
)


def number(field):
    """A number for a field: near its default, anywhere in its range in logarithms, at its ends or just beyond them."""
    meta = field.metadata
    default = field.default if isinstance(field.default, (int, float)) and np.isfinite(field.default) else 0.0
    low = meta["above"] if meta["at_least"] is None else meta["at_least"]
    high = meta["at_most"]
    ends = [low, high, np.nextafter(low, -np.inf), np.nextafter(high, np.inf), np.nextafter(low, np.inf)]
    size = st.floats(math.log(max(low, high * 1e-12)) if low >= 0 else -20.0, math.log(high)).map(math.exp)
    signed = st.tuples(size, st.sampled_from([1, -1] if low < 0 else [1])).map(math.prod)
    near = st.floats(0.5, 2.0).map(lambda factor: factor * default)
    return st.one_of(near, near, near, near, signed, st.sampled_from(ends).map(float))


def table_of(record, **more):
    fields = [field for field in dataclasses.fields(record) if field.metadata.get("leaf")]
    needed = {field.name: number(field) for field in fields if field.default is dataclasses.MISSING}
    others = {field.name: number(field) for field in fields if field.name not in needed}
    return st.fixed_dictionaries(needed | more, optional={k: v for k, v in others.items() if k not in more})


# Amplitudes that a gap takes, so that references are not all refused; others come by mutation.
SMALL = {"amplitude": st.floats(-3e-3, 3e-3), "std": st.floats(0, 2e-4), "value": st.floats(-3e-3, 3e-3)}
TIMES = {"start": st.floats(0, 0.01), "stop": st.floats(0.011, 0.02), "f_low": st.floats(0, 50)}


def signal(small):
    def one(name, kind):
        names = [field.name for field in dataclasses.fields(kind)]
        fixed = {k: v for k, v in (SMALL if small else {}).items() if k in names}
        return table_of(kind, kind=st.just(name), **fixed, **{k: v for k, v in TIMES.items() if k in names})

    alone = [one(name, kind) for name, kind in SIGNALS.items() if name != "sum"]
    terms = st.lists(st.one_of(alone[:4]), min_size=1, max_size=2)
    return st.one_of(*alone, st.fixed_dictionaries({"kind": st.just("sum"), "terms": terms}))


def law(stage):
    return st.one_of([table_of(kind, kind=st.just(name)) for name, kind in KINDS[stage].items()])


SPREAD_PATHS = ["plant.m", "plant.k_z", "plant.s_0", "initial.z", "sensor.std", "reference.amplitude", "actuator.u_max"]
SPREAD_PATHS += ["controller.inversion.gamma", "controller.position.c", "controller.model.m", "disturbance.q_z.shift"]
SPREAD = st.one_of(
    st.fixed_dictionaries({"percent": st.floats(0, 60)}, optional={"shape": st.sampled_from(["uniform", "normal"])}),
    st.fixed_dictionaries({"normal": st.floats(0, 1e-3)}),
    st.tuples(st.floats(-20, 5), st.floats(0, 10)).map(lambda x: {"uniform": [math.exp(x[0]), math.exp(x[0] + x[1])]}),
    st.tuples(st.floats(-60, 60), st.floats(0, 60)).map(
        lambda x: {"log-uniform": [math.exp(x[0]), math.exp(x[0] + x[1])]}
    ),
    st.lists(st.floats(1e-6, 1e3), min_size=1, max_size=4).map(lambda x: {"choices": x}),
)
CLOCK = st.one_of(
    st.just({"duration": 0.004, "sample_period": 1e-3}),
    st.just({"duration": 0.01}),
    st.builds(
        lambda dt, name: {"duration": 0.01, "dt": dt, "method": name},
        st.sampled_from([1e-4, 5e-5, 1e-6, 1e-14]),
        st.sampled_from(list(METHODS)),
    ),
    st.fixed_dictionaries(
        {}, optional={"duration": number(DURATION), "sample_period": number(FIELDS["sample_period"])}
    ),
)
LIMIT = st.floats(1e-6, 0.4) | st.just(0.4) | st.sampled_from([0.0, 1.2, math.inf])
ASKED = st.one_of(
    st.dictionaries(st.sampled_from([*LIMITS, "survival", "margin"]), st.floats(1e-6, 0.4), max_size=3),
    st.dictionaries(st.sampled_from([*LIMITS, "survival"]), LIMIT, max_size=2),
    st.fixed_dictionaries({"settling_s": st.floats(1e-3, 1.0), "settling_band_m": st.floats(1e-9, 1e-3)}),
)
# Ends of c, together or decades apart, mostly about its default, 17; one number in twenty is as any field's.
BOUNDS = st.tuples(st.floats(-3, 0.1), st.floats(-7, 3)).map(
    lambda x: [17 * 10 ** x[0], 17 * 10 ** x[0] * (1 + 10 ** x[1])]
)
TUNE = st.fixed_dictionaries(
    {"limits": ASKED},
    optional={
        "bounds": BOUNDS.map(lambda ends: {"controller": {"position": {"c": ends}}}),
        "weights": st.dictionaries(st.sampled_from(TERMS), st.floats(1e-6, 1e3), max_size=2),
        "risk": st.sampled_from(["mean", "cvar"]),
    }
    | {name: st.one_of(*[st.floats(0.1, 2.0)] * 19, number(field)) for name, field in TUNED.items()}
    | {name: st.integers(1, 100) for name in ("members", "held_out", "seed", "starts", "substeps")},
)
# Sensors and supplies without what is refused where there is no processor.
ALWAYS = ("std", "std_z_dot", "std_i", "offset", "gain")
NOISE = st.fixed_dictionaries({}, optional={f.name: number(f) for f in dataclasses.fields(Sensor) if f.name in ALWAYS})
SUPPLY = st.fixed_dictionaries({}, optional={"u_max": number(FIELDS["u_max"])})
DOCUMENT = st.fixed_dictionaries(
    {"clock": CLOCK},
    optional={
        "plant": table_of(Plant),
        "controller": st.fixed_dictionaries({}, optional={"model": table_of(Plant)} | {s: law(s) for s in KINDS}),
        "reference": signal(small=True),
        "disturbance": st.fixed_dictionaries({}, optional={"q_z": signal(small=False), "q_i": signal(small=False)}),
        "processor": st.fixed_dictionaries(
            {},
            optional={
                "delay": st.floats(-0.1, 2.1),
                "discretisation": st.sampled_from(["implicit", "explicit", "hold"]),
                "predict": st.sampled_from([True, False, 1]),
            },
        ),
        "tune": TUNE,
        "sensor": st.one_of(NOISE, NOISE, table_of(Sensor, bits=st.integers(1, 33))),
        "actuator": st.one_of(SUPPLY, SUPPLY, table_of(Amplifier, u_max=number(FIELDS["u_max"]))),
        "initial": table_of(Initial, z=st.floats(-3e-3, 3e-3)),
        "run": st.fixed_dictionaries(
            {}, optional={"seed": st.integers(0, 2**32), "settle": st.floats(0, 0.01), "clearance": st.floats(0, 6e-3)}
        ),
        "spread": st.dictionaries(st.sampled_from(SPREAD_PATHS), SPREAD, max_size=3).flatmap(
            lambda table: st.fixed_dictionaries(
                {path: st.just(how) for path, how in table.items()}, optional={"design": st.sampled_from([*DESIGNS])}
            )
        ),
    },
)


def nested(document):
    """Dotted keys of [spread] as the tables that TOML makes of them."""
    if isinstance(document.get("spread"), dict):
        tree = {}
        for path, how in document["spread"].items():
            *tables, last = path.split(".")
            at = tree
            for name in tables:
                at = at.setdefault(name, {})
            at[last] = how
        document["spread"] = tree
    return document


def spots(node, found):
    """Return every (table or list, key) of a document."""
    items = node.items() if isinstance(node, dict) else enumerate(node)
    for key, value in items:
        found.append((node, key))
        if isinstance(value, (dict, list)):
            spots(value, found)
    return found


@st.composite
def texts(draw_from):
    """Return the text of a case file with a valid structure.

    Half of the files have up to three random errors, and some are nonsense.
    """
    if draw_from(st.integers(0, 30)) == 0:
        return draw_from(st.text(max_size=40))
    document = nested(copy.deepcopy(draw_from(DOCUMENT)))
    for _ in range(draw_from(st.sampled_from([0, 0, 0, 1, 1, 2, 3]))):
        places_ = spots(document, [])
        node, key = places_[draw_from(st.integers(0, len(places_) - 1))]
        wound = draw_from(st.sampled_from(["value", "value", "value", "delete", "rename", "add"]))
        if wound == "value" or isinstance(node, list):
            node[key] = copy.deepcopy(draw_from(HOSTILE))
        elif wound == "delete":
            del node[key]
        elif wound == "rename":
            node[draw_from(st.sampled_from([key + "_", key[:-1] or "x", "a b", "\n", "", *TABLES]))] = node.pop(key)
        else:
            name = draw_from(st.sampled_from(["kind", "unit", "value", "percent", "design", "tune", "x"]))
            node[name] = copy.deepcopy(draw_from(HOSTILE))
        if not spots(document, []):
            break
    return dumps(document)


@dataclasses.dataclass
class Tally:
    """The number of files with each result, and the structures that have been compiled."""

    refused: int = 0
    read: int = 0
    run: int = 0
    structures: set = dataclasses.field(default_factory=set)


def hold(text, path, tally, run):
    """Check that a file with this text is refused in one line that names it, or is read and drawn from.

    With `run`, a file that is read is also simulated.
    """
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    try:
        case, tune, _ = read_tune(path) if "[tune" in text else (read_case(path), None, None)
    except ValueError as error:
        message = str(error)
    else:
        message = ""
    if message:
        tally.refused += 1
        assert message.startswith(str(path))
        assert message.isprintable()
        return
    tally.read += 1
    if tune is not None:
        start = tune.space.values(case.cascade)
        inside = tune.space.clip(start)
        assert all(gain.low < value < gain.high for gain, value in zip(tune.space.gains, inside, strict=True))
        assert np.all(np.isfinite(tune.space.encode(inside)))
    assert all(line.isprintable() for line in warnings_of(case))
    known = places(case.cascade, case.scenario)
    for where, values in draw(case.spread, case.cascade, case.scenario, 0, np.arange(8), 8).items():
        low, high = dict(case.spread.entries)[where].support(float(known[where].value or 0.0))
        assert np.all((low <= values) & (values <= high))
    short = dataclasses.replace(case, clock=dataclasses.replace(case.clock, samples=SAMPLES), settle=0.0)
    structure = jax.tree.structure((short.cascade, short.scenario, short.clock))
    known = structure in tally.structures
    if run and tally.read % ONE_IN == 0 and (known or len(tally.structures) < MOST_STRUCTURES):
        tally.structures.add(structure)
        tally.run += 1
        run_of_case = simulate(short)
        for name, value in {**run_of_case.trajectory.rows._asdict(), **run_of_case.metrics}.items():
            assert not np.any(np.isnan(value)), name


@pytest.mark.parametrize(
    ("count", "run"), [(100, False), pytest.param(examples(100, 8_000), True, marks=pytest.mark.slow)]
)
def test_changed_files_are_read_or_refused_in_one_line(count, run, tmp_path):
    """The slow test also simulates files that are read."""
    tally = Tally()

    @settings(max_examples=count, derandomize=True, deadline=None, database=None, suppress_health_check=[*HealthCheck])
    @given(texts())
    def examine(text):
        hold(text, tmp_path / "case.toml", tally, run)

    examine()
    assert min(tally.refused, tally.read) > count / 7  # or nothing was attacked, or nothing was let through
    assert tally.run > examples(1, 150) or not run
