"""FMUs, run by fmpy: controller and plant in a loop are the simulator's; parameters, reset, NaN, instances, sources."""

import contextlib
import functools
import pathlib
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from profiles import thorough
from test_export import compiled
from test_export_blocks import rig
from texts import refusal, write

from ambjax import rollout
from ambjax.cases.reader import read_case
from ambjax.codegen.c99.source import Origin
from ambjax.codegen.fmi.archive import files_of, packed, sources
from ambjax.codegen.fmi.description import description, exponents, variables
from ambjax.codegen.loop_step import WHAT, block_of
from ambjax.codegen.trace import trace
from ambjax.codegen.twins import LoopCase, horizons, series

ORIGIN = Origin("test", "0" * 64, [])
F20 = pathlib.Path(__file__).parents[1] / "benchmarks" / "tasks" / "sampled" / "F20.toml"


@functools.cache
def traced(what):
    return trace(block_of(what, *rig()), "double")


@pytest.mark.parametrize("version", [2, 3])
def test_the_description_lists_every_number_that_the_block_reads(version):
    one = traced("controller")
    root = ET.fromstring(description(one, "amb", "rig", "{1}", ["amb.c"], version))
    assert root.get("fmiVersion") == f"{version}.0"
    rows = root.find("ModelVariables")
    found = {row.get("name"): row for row in rows}
    assert len(found) == len(rows)
    own = {x.name: x.value for x in one.parameters if x.allowed != "not read"}
    values = {name: found[name].find("Real") if version == 2 else found[name] for name in own}
    assert {name: float(value.get("start")) for name, value in values.items()} == own
    assert {name for name, row in found.items() if row.get("causality") == "input"} == one.read
    assert {found[name].get("variability") for name in own} == {"tunable"}
    units = {unit.get("name") for unit in root.find("UnitDefinitions")}
    assert {x.unit for x in variables(one) if x.unit} - units <= {"s"}
    assert all(exponents(unit) is not None for unit in units)
    assert len({row.get("valueReference") for row in rows}) == len(rows)


def written(folder, block, version=3, name="amb"):
    path = folder / f"{name}.fmu"
    path.write_bytes(packed(trace(block, "double"), name, ORIGIN, version))
    return path


class Unit:
    """An instance of an FMU, whose numbers are accessed by name."""

    def __init__(self, path, folder, name="one"):
        import fmpy
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        self.about = fmpy.read_model_description(path)
        self.at = {x.name: x.valueReference for x in self.about.modelVariables}
        self.three = self.about.fmiVersion == "3.0"
        if not folder.exists():
            fmpy.extract(str(path), str(folder))
        kind = FMU3Slave if self.three else FMU2Slave
        given = {"unzipDirectory": str(folder), "modelIdentifier": self.about.coSimulation.modelIdentifier}
        self.fmu = kind(guid=self.about.guid, instanceName=name, **given)
        self.fmu.instantiate()

    def begin(self, **inputs):
        if not self.three:
            self.fmu.setupExperiment()
        self.fmu.enterInitializationMode()
        self.set(**inputs)
        self.fmu.exitInitializationMode()
        self.n = 0
        return self

    def set(self, **values):
        put = self.fmu.setFloat64 if self.three else self.fmu.setReal
        put([self.at[name] for name in values], list(values.values()))

    def get(self, *names):
        take = self.fmu.getFloat64 if self.three else self.fmu.getReal
        return dict(zip(names, take([self.at[name] for name in names]), strict=True))

    @property
    def status(self):
        take = self.fmu.getUInt32 if self.three else self.fmu.getInteger
        return take([self.at["status"]])[0]

    def step(self, period, **inputs):
        self.set(**inputs)
        self.fmu.doStep(self.n * period, period)
        self.n += 1
        return self


def close(*units):
    for unit in units:
        with contextlib.suppress(Exception):
            unit.fmu.terminate()
        unit.fmu.freeInstance()


def looped(controller, plant, x, count, period, at_once=False):
    """z and u of a loop of two FMUs: in each sample the controller steps first, then the plant.

    `at_once`: all inputs are exchanged before both step, as Simulink does; the plant's delay is one sample less.
    """
    if at_once:
        plant.set(delay=plant.get("delay")["delay"] - 1)
    noise = {"w_z", "w_z_dot", "w_i"} & {*plant.at}
    references = {"r", "r_dot", "r_ddot", "r_dddot"} & {*controller.at}
    readings = {"z", "z_dot", "i"} & {*controller.at}
    controller.begin()
    plant.begin(**{name: x[name][0] for name in noise})
    z, u = np.empty(count), np.empty(count)
    for n in range(count):
        z[n] = plant.get("z_true")["z_true"]
        controller.step(period, **plant.get(*readings), **{name: x[name][n] for name in references})
        u[n] = controller.get("u")["u"]
        now = u[n] if not at_once else u[n - 1] if n else 0.0
        late = {name: x[name][n + 1] for name in (*noise, "q_z", "q_i")}
        plant.step(period, u=now, **late)
    return z, u


@compiled
@pytest.mark.parametrize(
    ("version", "name"),
    [
        pytest.param(version, name, marks=pytest.mark.slow if usual else pytest.mark.thorough)
        for version, name, usual in ((3, "F20", 0), (2, "F20", 0), (3, "rig", 0), (3, "rig, at once", 1))
    ],
)
def test_controller_and_plant_in_a_loop_equal_simulate(version, name, tmp_path):
    pytest.importorskip("fmpy")
    if name == "F20":
        case = read_case(F20)
        cascade, scenario, clock = case.cascade, case.scenario, case.clock
    else:
        cascade, scenario, clock = rig()
        clock = clock.with_method(block_of("plant", *rig()).method)
    period = float(clock.sample_period)
    blocks = {what: block_of(what, cascade, scenario, clock) for what in WHAT}
    units = [Unit(written(tmp_path, blocks[what], version, what), tmp_path / what) for what in ("controller", "plant")]
    horizon = horizons(LoopCase(cascade, scenario, clock, 0.0), ["double"])["double"]
    count = horizon.samples
    assert count > 50
    x = series(cascade, scenario, clock, count + 1)
    z, u = looped(*units, x, count, period, at_once="at once" in name)
    rows = rollout(cascade, scenario, clock).trajectory.rows
    close(*units)
    # the farthest of eight twins, one unit in the last place apart, bounds what rounding does (ambjax/codegen/twins.py)
    assert np.all(np.abs(z - rows.z[:count]) <= 2 * horizon.parted["z"][:count] + 1e-18)
    assert np.all(np.abs(u - rows.u[:count]) <= 2 * horizon.parted["u"][:count] + 1e-12)
    assert np.ptp(rows.z[:count]) > 1e-6


@pytest.mark.slow
@compiled
@pytest.mark.parametrize("version", [2, 3])
def test_a_changed_gain_a_reset_a_nan_and_a_second_instance(version, tmp_path):
    pytest.importorskip("fmpy")
    block = block_of("controller", *rig())
    path, period = written(tmp_path, block, version), block.period
    one, other = (Unit(path, tmp_path / "there", name) for name in ("one", "other"))
    given = {"z": 4e-5, "i": 0.1}

    def run(unit, count=5, **more):
        return [unit.step(period, **given, **more).get("u", "i_ref")["u"] for _ in range(count)]

    first = run(one.begin())
    assert len(set(first)) > 1
    # a second instance is another controller, whatever the first has done
    assert run(other.begin()) == first
    # reset: the values of the case, and the first step again; a gain that was changed is forgotten
    one.set(**{"position.c": 1000.0})
    assert run(one) != run(other)
    one.fmu.reset()
    assert run(one.begin()) == first
    # a gain changed between two steps acts from the next on
    one.set(**{"position.c": 1000.0})
    assert one.get("position.c")["position.c"] == 1000.0
    other.fmu.reset()
    assert run(other.begin()) == first
    assert run(one, 1) != run(other, 1)
    # NaN: a reading is refused, a reference is invalid; u stays a number. A parameter may not be NaN, nor be infinite
    bits = {name: 1 << k for k, name in enumerate(block.bits)}
    u = one.step(period, z=np.nan, i=0.1).get("u")["u"]
    assert one.status & bits["refused"]
    assert np.isfinite(u)
    held = one.step(period, z=4e-5, r=np.nan).get("u")["u"]
    assert one.status & bits["invalid"]
    assert held == u
    # 1e300 stands for infinity in FMI 2.0 alone
    infinite, no_end = ([np.inf, 1e300], []) if version == 2 else ([np.inf], [1e300])
    for name, wrong in {
        "position.c": (np.nan, np.inf, -1.0, 0.0, 1e31),
        "model.m": (-1.0, 0.0, 1e7),
        "processor.guard.samples": (2.5, 0.0, 1e7),
        "limits.u_max": (np.nan, 1e13, *no_end),
    }.items():
        for value in wrong:
            with pytest.raises(Exception, match=r"rror|status 3"):
                one.set(**{name: value})
    # its bounds, and its value
    for name, right in {
        "model.m": (1e-6, 1e6, 1.64),
        "processor.guard.samples": (1.0, 1e6),
        "limits.u_max": (*infinite, 48.0),
    }.items():
        for value in right:
            one.set(**{name: value})
    # some tools read every output as a real number
    assert one.get("status")["status"] == one.status != 0
    with pytest.raises(Exception, match=r"rror|status 3"):
        one.set(u=1.0)  # an output
    with pytest.raises(Exception, match=r"rror|status 3"):
        one.step(0.7 * period, z=0.0, r=0.0)
    close(one, other)


@compiled
@pytest.mark.parametrize("version", [thorough(2), pytest.param(3, marks=pytest.mark.slow)])
def test_an_fmu_compiled_again_from_its_sources_gives_the_reference(version, tmp_path):
    """As a real-time target does, the test compiles the sources alone, with another build system."""
    fmpy = pytest.importorskip("fmpy")
    from fmpy.build import build_platform_binary
    from fmpy.validation import validate_fmu

    cascade, scenario, clock = rig()
    block = block_of("plant", cascade, scenario, clock)
    path, folder = written(tmp_path, block, version), tmp_path / "there"
    assert validate_fmu(str(path)) == []
    fmpy.extract(str(path), str(folder))
    (old,) = (folder / "binaries").glob("*/amb.*")
    old.unlink()
    with pytest.raises(Exception, match="amb"):
        Unit(path, folder)
    (tmp_path / "build").mkdir()
    build_platform_binary(folder, tmp_path / "build")
    files = files_of(block, "amb", trace(block, "double").read, cascade, scenario, clock)
    texts = (files[f"amb_{x}.csv"].replace('"', "").splitlines() for x in ("in", "ref"))
    given, should = (np.genfromtxt(text, delimiter=",", names=True) for text in texts)
    names = [name for name in given.dtype.names if name != "time"]
    unit = Unit(path, folder)
    unit.begin(**{name: given[name][0] for name in names})
    found = [unit.get("z_true")["z_true"]]
    for row in given:
        unit.step(block.period, **{name: row[name] for name in names})
        found.append(unit.get("z_true")["z_true"])
    close(unit)
    # an error of 1e-20 m grows by 1e4 (GROWTH)
    np.testing.assert_allclose(found, should["z_true"], rtol=0, atol=1e-15)


def test_options_that_an_fmu_lacks_are_refused(elsewhere, capsys, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    case = write("[processor]\n[clock]\nduration = 0.01\n")
    for options, said in {
        "--fmi 2": "--fmi 2: it is the version of an FMU",
        "--format fmu --precision float": "--precision float: --format fmu computes in double",
        "--format fmu": "--format fmu: there is no C compiler (no-such-compiler). Install one, set CC, or use",
    }.items():
        assert said in refusal(capsys, "export", case, "--out", "fmu", *options.split())
    assert not pathlib.Path("fmu").exists()


def test_the_sources_are_reproducible_and_name_the_block():
    one = traced("plant")
    files, guid = sources(one, "amb", ORIGIN, 3)
    assert (files, guid) == sources(one, "amb", ORIGIN, 3)
    assert f'#define MODEL_TOKEN "{guid}"' in files["model.h"]
    assert "#define MODEL_READS_AT_START 1" in files["model.h"]
    other = trace(block_of("plant", *rig(clearance=2e-4)), "double")
    assert sources(other, "amb", ORIGIN, 3)[1] != guid
