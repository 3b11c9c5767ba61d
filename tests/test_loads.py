"""Loads in newtons and their signals: against closed forms."""

import dataclasses
import importlib.util
import re

import jax
import numpy as np
import pytest
from test_synchronous_notch import LAWS

import ambjax as amb
from ambjax.cases.reader import case_from, read_case
from ambjax.commands.sensitivity import references
from ambjax.ensemble.spread import apply
from ambjax.linear import linearise
from ambjax.world.rotation import Rotation
from tuning.report.folder import tuned_case

STEP = {"kind": "step", "amplitude": 20.0, "start": 0.1}
SINE = {"kind": "sine", "amplitude": 8.0, "frequency": 300.0}
T = np.array([0.0, 0.05, 0.1, 0.123, 0.4])


def world(**tables):
    return case_from(tables).scenario


def test_a_force_in_newtons_is_divided_by_the_mass_of_each_member():
    case = case_from({"plant": {"m": 2.0}, "disturbance": {"q_z": STEP | {"unit": "N"}}})
    np.testing.assert_array_equal(case.scenario.acceleration(T), 10.0 * (T >= 0.1))
    m = np.array([1.0, 2.0, 4.0])
    _, spread = apply(case.cascade, case.scenario, {"plant.m": m})
    np.testing.assert_array_equal(spread.acceleration(0.2), 20.0 / m)
    # likewise where the mass and the force are traced: the derivative of F/m in m is -F/m^2
    slope = jax.grad(lambda m: apply(case.cascade, case.scenario, {"plant.m": m})[1].acceleration(0.2))(2.0)
    assert slope == -5.0


def test_disturbances_of_several_units_act_together():
    mixed = [STEP | {"unit": "N"}, SINE, SINE | {"unit": "N"}, {"kind": "constant", "value": 3.0, "unit": "A^2/m^2"}]
    one = world(plant={"m": 2.0}, disturbance={"q_z": mixed, "base": {"kind": "constant", "value": 0.7}})
    wave = 8.0 * np.sin(2 * np.pi * 300 * T)
    expected = 10.0 * (T >= 0.1) + wave + wave / 2 + 3.0 * one.plant.a - 0.7
    # rounding of a few operations
    np.testing.assert_allclose(one.acceleration(T), expected, rtol=1e-12, atol=1e-12)
    assert one.edges() == (0.1,)
    assert one.undisturbed().acceleration(0.2) == 0


RPM = 2 * np.pi / 60


@pytest.mark.parametrize(
    ("signal", "knots"),
    [
        (amb.signals.Ramp(3.0, 0.1, 0.2), [(0, 0), (0.1, 0), (0.3, 3), (9, 3)]),
        (amb.signals.Trapezoid(-2.0, 0.1, 0.05, 0.1, 0.2), [(0.1, 0), (0.15, -2), (0.25, -2), (0.45, 0), (9, 0)]),
        (amb.signals.Trapezoid(2.0, 0.1, 0.05, 0.0, 0.2), [(0, 0), (0.1, 0), (0.15, 2), (0.35, 0), (9, 0)]),
    ],
)
def test_piecewise_linear_signals_pass_through_their_corners(signal, knots):
    t = np.linspace(0, 0.6, 61)
    np.testing.assert_allclose(signal(t), np.interp(t, *np.array(knots).T), rtol=0, atol=1e-14)
    low, high = signal.span(0.6)
    assert low <= np.min(signal(t))
    assert high >= np.max(signal(t))
    np.testing.assert_allclose(signal.shifted(0.05)(t + 0.05), signal(t), rtol=0, atol=1e-13)


def test_the_force_of_an_unbalance_by_hand():
    # 120 g mm at 6000 rpm: 1.2e-4 kg m (628 1/s)^2 = 47.4 N
    t = np.linspace(0, 0.05, 40)
    force = amb.signals.Unbalance(120.0, 0.4, Rotation(6000.0))(t)
    np.testing.assert_allclose(force, 1.2e-4 * (6000 * RPM) ** 2 * np.sin(6000 * RPM * t + 0.4), rtol=0, atol=1e-10)
    # G 2.5 at 6000 rpm: e = 2.5e-3/628 = 3.98 um, and twice the service speed is four times the acceleration
    acceleration = amb.signals.UnbalanceGrade(2.5, 6000.0, rotation=Rotation(12000.0))(t)
    expected = 4 * 2.5e-3 * 6000 * RPM * np.sin(2 * 6000 * RPM * t)
    np.testing.assert_allclose(acceleration, expected, rtol=0, atol=1e-11)
    # 2400 rpm in 0.2 s
    run_up = amb.signals.Unbalance(120.0, 0.3, Rotation(600.0, 12000.0, 3000.0))
    assert run_up.span(1.0)[1] == pytest.approx(1.2e-4 * (3000 * RPM) ** 2)


# Forces of 1e-4 of the weight and a runout of 5 nm: products of them are below 1e-6 of the response.
ROTATING = {
    "controller": LAWS,
    "rotor": {"speed": 3000.0},
    "disturbance": {"q_z": {"kind": "unbalance", "unbalance": 0.05, "phase": 0.2}},
    "sensor": {"runout": {"harmonics": [{"number": 2, "amplitude": 5e-9, "phase": -0.5}]}},
    "clock": {"duration": 0.2, "sample_period": 1e-4},
}


def lines(rows, name, settled=1000):
    """Return the complex amplitudes of a signal at the speed and at twice the speed, over whole turns."""
    t, x = np.asarray(rows.t)[settled:], np.asarray(getattr(rows, name))[settled:]
    return np.array([2 * np.mean(x * np.exp(-1j * k * 3000 * RPM * t)) for k in (1, 2)])


def test_the_response_to_unbalance_and_runout_agrees_with_the_linear_loop():
    """Amplitude and phase of z at the speed and at twice the speed, against the frequency responses of the loop."""
    case = case_from(ROTATING)
    start = amb.Initial(i=float(case.scenario.plant.equilibrium(0.0)[0]))
    rows = amb.rollout(case.cascade, dataclasses.replace(case.scenario, initial=start), case.clock).trajectory.rows
    response = linearise(case.cascade, case.scenario, case.clock).response(np.array([50.0, 100.0]))
    # sin(w t + phase) has the complex amplitude exp(j phase)/j
    load = 0.05e-6 * (3000 * RPM) ** 2 / case.scenario.plant.m * np.exp(0.2j) / 1j
    runout = 5e-9 * np.exp(-0.5j) / 1j
    expected = np.array([response[0, 3, 2] * load, response[1, 3, 0] * runout])
    # the start has decayed to exp(-15) of 30 nm; products of load and runout are 1e-6 of the smaller one
    np.testing.assert_allclose(lines(rows, "z"), expected, rtol=1e-5)
    # the sensor reads the sum; the true position does not contain it
    np.testing.assert_allclose(lines(rows, "z_measured")[1], expected[1] + runout, rtol=1e-5)


def test_unbalance_and_runout_share_the_angle_of_the_rotor():
    """One number changes the speed of everything; keys of each load, in a case without [rotor], mean the same."""
    rotor = {"speed": 600.0, "acceleration": 12000.0, "speed_end": 3000.0}
    case, t = case_from(ROTATING | {"rotor": rotor}), np.linspace(0, 0.35, 8)
    own = {"speed": 600.0, "speed_end": 3000.0, "duration": 0.2}
    each = {
        "disturbance": {"q_z": ROTATING["disturbance"]["q_z"] | own},
        "sensor": {"runout": ROTATING["sensor"]["runout"] | own},
    }
    apart = case_from({name: table for name, table in (ROTATING | each).items() if name != "rotor"})
    faster = apply(case.cascade, case.scenario, {"rotor.speed": 1200.0})[1]
    for one in (case.scenario, apart.scenario, faster):
        one = one.realised()
        start = 1200.0 if one.rotor is not None and one.rotor.speed == 1200.0 else 600.0
        rise = (3000.0 - start) / 12000.0
        turned = start * np.minimum(t, rise) + 6000.0 * np.minimum(t, rise) ** 2 + 3000.0 * np.maximum(t - rise, 0)
        speed = np.minimum(start + 12000.0 * t, 3000.0)
        force = 0.05e-6 * (RPM * speed) ** 2 * np.sin(RPM * turned + 0.2)
        np.testing.assert_allclose(one.acceleration(t), force / one.plant.m, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(one.sensor.runout(t), 5e-9 * np.sin(2 * RPM * turned - 0.5), rtol=0, atol=1e-17)


def test_the_low_pass_of_the_sensor_acts_on_the_runout():
    raw = ROTATING | {"processor": {"delay": 0.0}, "sensor": ROTATING["sensor"] | {"bandwidth": 200.0}}
    case = case_from(raw)
    rows = amb.rollout(case.cascade, case.scenario, case.clock).trajectory.rows
    surface = lines(rows, "z") + np.array([0, 5e-9 * np.exp(-0.5j) / 1j])
    expected = surface / (1 + 1j * np.array([50.0, 100.0]) / 200.0)
    # cubic through the ends of a sample: (w T)^4 / 384 = 4e-8
    np.testing.assert_allclose(lines(rows, "z_measured"), expected, rtol=2e-7)


def write(tmp_path, name, t, value):
    if name.endswith("npz"):
        np.savez(tmp_path / name, t=t, value=value)
    else:
        np.savetxt(tmp_path / name, np.stack([t, value], 1), delimiter=",", header="t,value", comments="")


@pytest.mark.parametrize("name", ["load.csv", "load.npz"])
def test_a_table_reproduces_the_sampled_signal(name, tmp_path):
    knots = np.array([0.0, 0.1, 0.3, 0.4])
    write(tmp_path, name, knots, np.array([0.0, 0.0, 3.0, 3.0]))
    load = {"kind": "table", "file": name, "unit": "N", "scale": 2.0, "start": 0.5}
    case = case_from({"disturbance": {"q_z": load}}, folder=tmp_path)
    t = np.linspace(0, 1.5, 151)
    np.testing.assert_allclose(case.scenario.q_f(t), amb.signals.Ramp(6.0, 0.6, 0.2)(t), rtol=0, atol=1e-13)
    assert case.scenario.q_f.span(1.0) == (0, 6)
    # held: each value until the next time, at which it jumps
    held = case_from({"disturbance": {"q_z": load | {"interpolation": "held"}}}, folder=tmp_path).scenario.q_f
    np.testing.assert_array_equal(held(0.5 + np.array([-1, 0.2, 0.2999, 0.3, 9])), [0, 0, 0, 6, 6])
    # the file is a part of the structure: equal numbers give an equal tree, other numbers another
    assert jax.tree.structure(held) == jax.tree.structure(held.shifted(1.0))
    other = dataclasses.replace(held, samples=amb.signals.Samples(knots, knots))
    assert jax.tree.structure(held) != jax.tree.structure(other)


def test_a_written_case_finds_its_tables(tmp_path):
    write(tmp_path, "load.csv", np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    text = (
        '[disturbance]\nbase = { kind = "table", file = "load.csv" }\n'
        '[[disturbance.q_z]]\nkind = "table"\nunit = "N"\nfile = "load.csv"\n'
        '[[disturbance.q_z]]\nkind = "sum"\nterms = [{ kind = "table", file = "./load.csv" }]\n'
    )
    (tmp_path / "case.toml").write_text(text)
    case = read_case(tmp_path / "case.toml")
    out = tmp_path / "out" / "tuned"
    out.mkdir(parents=True)
    written, again = tuned_case(case, {"controller.position.c": 20.0}, "", out)
    (out / "tuned.toml").write_text(written)
    found = read_case(out / "tuned.toml")
    assert {one.written for one in found.files} == {"../../load.csv"}
    assert [one.file for one in found.files] == [one.file for one in case.files]
    assert found.scenario == again.scenario == case.scenario


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize(
    ("between", "point", "end"),
    [(",", ".", "csv"), (";", ".", "csv"), (";", ",", "txt"), ("\t", ",", "tsv"), ("   ", ".", "txt")],
)
def test_a_text_file_is_read_with_any_separator_and_decimal_mark(between, point, named, end, tmp_path):
    t, value = np.array([0.0, 0.125, 1.0]), np.array([-1.5, 2e-3, 1234.5])
    rows = [["t", "value"]] * named + [
        [repr(float(x)).replace(".", point) for x in row] for row in zip(t, value, strict=True)
    ]
    (tmp_path / f"x.{end}").write_text("# comment; with, all\tmarks\n" + "\n".join(between.join(row) for row in rows))
    load = {"kind": "table", "file": f"x.{end}", "unit": "N"}
    found = case_from({"disturbance": {"q_z": load}}, folder=tmp_path).scenario.q_f.samples
    np.testing.assert_array_equal(found.times, t)
    np.testing.assert_array_equal(found.values, value)


GOOD = "t,value\n0,1\n1,2\n"


@pytest.mark.parametrize(
    ("text", "keys", "said"),
    [
        (None, {}, r"file = \"x.csv\": .*x.csv cannot be read \(No such file or directory\). A path is relative"),
        (GOOD, {"file": "x.doc"}, "must be the path of a file, '.csv', '.tsv', '.txt', '.npz' or '.parquet'"),
        (GOOD, {"columns": ["t"]}, r"columns = \[\"t\"\]: it must be two names"),
        (GOOD, {"columns": ["t", "force"]}, "no column 'force'. Its columns: t, value"),
        (GOOD, {"interpolation": "cubic"}, "interpolation = \"cubic\": it must be one of 'linear' or 'held'"),
        (GOOD, {"amplitude": 2.0}, "amplitude = 2.0: unknown key"),
        ("", {}, "it is empty"),
        ("0;1\n1,2\n", {}, "line 2 has 1 columns, but the first line has 2"),
        ('0,1\n1,"1,500"\n', {}, 'line 2: "1,500" is not a number'),
        ("0;1\n1;1.234,5\n", {}, 'line 2: "1.234,5" is not a number'),
        ("t,a,b\n0,1,2\n1,2,3\n", {}, "it has the columns t, a, b; name those"),
        ("0,1\n", {}, "times and values have 1 rows; give 2 to"),
        ("0,1\n1,\n", {}, "line 2: the cell of column '2' is empty. Give a number"),
        ("0,1\n1,nan\n", {}, "the value of row 2 is nan; each must be a finite number"),
        ('t,"value\n0,1\n1,2\n', {}, 'a quotation mark " is not closed'),
        pytest.param('t,"value\n' + "0,1\n" * 50_000, {}, 'a quotation mark " is not closed', id="long"),
    ],
)
def test_wrong_tables_are_refused(text, keys, said, tmp_path):
    if text is not None:
        (tmp_path / "x.csv").write_text(text)
    with pytest.raises(ValueError, match=r"disturbance\.q_z\..*") as error:
        case_from({"disturbance": {"q_z": {"kind": "table", "file": "x.csv"} | keys}}, folder=tmp_path)
    assert re.search(said, str(error.value))
    assert "\n" not in str(error.value)


def test_wrong_arrays_are_refused(tmp_path):
    path, plain = tmp_path / "x.npz", tmp_path / "x.npy"
    np.save(plain, np.eye(2))
    for write_file, said in (
        (lambda: np.savez(path, t=np.zeros((2, 2)), value=np.zeros(2)), r"two lists .*shapes are \(2, 2\), \(2,\)"),
        (lambda: np.savez(path, t=np.arange(2), value=np.array(["a", "b"])), "values are not real numbers"),
        (lambda: path.write_text("no"), "npz file of plain"),
        (lambda: path.write_bytes(plain.read_bytes()), "npz file of plain"),
    ):
        write_file()
        with pytest.raises(ValueError, match=said):
            case_from({"disturbance": {"q_z": {"kind": "table", "file": "x.npz"}}}, folder=tmp_path)


@pytest.mark.parametrize("name", ["x.npz", "y.csv"])
def test_a_link_to_a_file_of_another_ending_is_read(name, tmp_path):
    with (tmp_path / "data").open("wb") as file:
        np.savez(file, t=np.arange(2.0), value=np.array([1.0, 3.0])) if name == "x.npz" else file.write(b"0,1\n1,3\n")
    (tmp_path / name).symlink_to("data")
    case = case_from({"disturbance": {"q_z": {"kind": "table", "file": name}}}, folder=tmp_path)
    assert case.scenario.q_z(0.5) == 2.0


def test_samples_are_checked_and_converted():
    Samples = amb.signals.Samples
    for times, values, said in (
        ([0, 1], [0, np.nan], "the value of row 2 is nan; each must be a finite number"),
        ([0, 2, 1], [0, 0, 0], "times must increase: row 3 has 1 s after 2 s"),
        ([0, 1], [0, 1, 2], r"equal length; their shapes are \(2,\), \(3,\)"),
        ([], [], "times and values have 0 rows; give 2 to 200,000"),
        ([[0, 1], [2]], [0, 1], "times are not real numbers"),
    ):
        with pytest.raises(ValueError, match=said):
            Samples(times, values)
    with pytest.raises(ValueError, match="values are not real numbers"):
        jax.jit(lambda x: Samples([0, 1], x))(T[:2])
    found = Samples([0, 1], jax.numpy.asarray([2.0, 3.0], "float32"))
    assert found == Samples(np.array([0.0, 1.0]), np.array([2.0, 3.0]))
    assert {type(x) for x in (found.times, found.values)} == {np.ndarray}
    assert found.values.dtype == np.float64
    assert amb.signals.Recorded(found)(0.5) == 2.5


def test_parquet_needs_its_extra(tmp_path):
    table = {"disturbance": {"q_z": {"kind": "table", "file": "x.parquet"}}}
    if importlib.util.find_spec("pyarrow") is None:
        with pytest.raises(ValueError, match=r"pyarrow is not installed. Install it .*'ambjax\[tables\]'"):
            case_from(table, folder=tmp_path)
        return
    from pyarrow import parquet
    from pyarrow import table as arrow  # pyright: ignore

    parquet.write_table(arrow({"t": [0.0, 1.0], "value": [1.0, 3.0]}), tmp_path / "x.parquet")
    assert case_from(table, folder=tmp_path).scenario.q_z(0.5) == 2.0


TURNING, RUNOUT = {"kind": "unbalance", "unbalance": 1.0, "speed": 1.0}, {"sensor": {"runout": {"speed": 1.0}}}


def load(table, name="q_z"):
    return {"disturbance": {name: table}}


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        (load([]), r"disturbance.q_z = \[\]: it must be a list of 1 to 100 signal tables"),
        (load([STEP, 3]), r"disturbance.q_z\[1\] = 3: it must be a table"),
        (load([STEP | {"unit": "kg"}]), r"q_z\[0\].unit = \"kg\": it must be one of 'm/s\^2', 'N' or"),
        (load(STEP | {"unit": "N"}, "base"), "disturbance.base.unit"),
        (load(STEP, "force"), "disturbance.force"),
        (load(TURNING, "q_i"), "gives N, but a signal in A/s"),
        ({"reference": TURNING}, "gives N, but a signal in m belongs"),
        (load(TURNING | {"unit": "m/s^2"}), "gives N, but a signal in m/s\\^2"),
        (ROTATING | load(TURNING), "disturbance.q_z.speed: it turns with"),
        (load({"kind": "unbalance", "unbalance": 1.0}), r"\[rotor\] is missing: disturbance.q_z"),
        ({"rotor": {"speed": 1.0, "speed_end": 2.0}}, "rotor.speed_end = 2: from speed = 1 rpm, an acceleration of 0"),
        (RUNOUT, "sensor.runout.harmonics is missing: it must be a list of 1 to 100 tables"),
        ({"sensor": {"runout": {"harmonics": [{"number": 0.5, "amplitude": 1.0}]}}}, r"\[0\].number = 0.5: it must be"),
    ],
)
def test_wrong_loads_are_refused(tables, said):
    with pytest.raises(ValueError, match=said):
        world(**tables)


def test_a_reference_counts_within_the_run_only(tmp_path):
    # 5 mm is beyond the stop of the paper's rotor (4.5 mm); the recording reaches it at 2 s
    (tmp_path / "r.csv").write_text("0,0\n1,0.001\n2,0.005\n")
    table = {"reference": {"kind": "table", "file": "r.csv"}}
    case = case_from(table | {"clock": {"duration": 1.0}}, folder=tmp_path)
    assert references(case)[1] == ("at +reference", pytest.approx(1e-3, rel=1e-3))
    with pytest.raises(ValueError, match=r"reaches 0\.005 m within clock\.duration = 3 s"):
        case_from(table | {"clock": {"duration": 3.0}}, folder=tmp_path)
    # every zero of this sine is on a grid of 2,001 instants
    sine = {"reference": {"kind": "sine", "amplitude": 1e-3, "frequency": 1000.0}, "clock": {"duration": 1.0}}
    assert references(case_from(sine))[1] == ("at +reference", 1e-3)
