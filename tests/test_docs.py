"""The documentation agrees with the code: each link has a target, and each key has an entry. Sphinx is not needed."""

import ast
import dataclasses
import inspect
import itertools
import json
import math
import pathlib
import pkgutil
import re

import numpy as np
import pytest
from reference import benchmarks, case_file, commands, metrics, page_outputs, site
from reference.parser import remarks
from texts import write

import ambjax
from ambjax.__main__ import main
from ambjax.cases.controller_tables import KINDS
from ambjax.cases.reader import OTHERS, TABLES, case_from
from ambjax.cases.scenario_tables import SIGNALS
from ambjax.cases.speed_table import OWN_SPEED
from ambjax.cases.table import Table
from ambjax.numerics import declared
from ambjax.numerics.declared import default_text
from tuning.problem.config import tune_from

ROOT = pathlib.Path(__file__).parent.parent
PAGES = sorted((ROOT / "docs").glob("*.md"))
ROLE = re.compile(r"\{py:(\w+)\}`(?:[^`<]*<)?~?([\w.]+)>?`")
# Tables of the case file whose keys are rows of a page, with the other keys that the reader needs to accept a key.
ELSEWHERE = ("controller", "reference", "disturbance", "spread")
# Records that a user of the Python interface constructs.
LAWS = {kind for kinds in KINDS.values() for kind in kinds.values()}
SPACES = (ambjax, ambjax.signals, ambjax.plants, ambjax.sensors, ambjax.actuators, ambjax.solvers)
PUBLIC = {one for space in SPACES for name in space.__all__ if dataclasses.is_dataclass(one := getattr(space, name))}
RECORDS = sorted(
    {kind for kind in PUBLIC if any(field.metadata for field in dataclasses.fields(kind))} | {*LAWS, *SIGNALS.values()},
    key=lambda kind: f"{kind.__module__}.{kind.__qualname__}",
)
# Keys that the template does not show: a case with [rotor], which it shows, refuses them.
OWN_SPEEDS = {("sensor.runout", key) for key in OWN_SPEED}
NAMES = dict.fromkeys([*TABLES, *OTHERS, *case_file.RECORDS, "tune.weights", "tune.limits"])
ROWS = [(name, {}) for name in NAMES if name not in ELSEWHERE]
ROWS += [("reference", {"kind": kind}) for kind in SIGNALS]
ROWS += [(f"controller.{stage}", {"kind": kind}) for stage, kinds in KINDS.items() for kind in kinds]


def test_the_help_of_a_record_lists_its_fields():
    assert len(RECORDS) > 50
    for kind in RECORDS:
        items = {item.partition("`")[0]: " ".join(item.split()) for item in str(kind.__doc__).split("\n- `")[1:]}
        for field in (one for one in dataclasses.fields(kind) if one.init):
            unit = field.metadata.get("unit", "")
            words = default_text(field.default), "" if unit == "1" else unit, declared.allowed(field)
            assert all(word in items[field.name] for word in words), f"{kind.__qualname__}.{field.name}"


NAMESPACES = {name: getattr(ambjax, name) for name in ["laws", "signals", "plants", "sensors", "actuators", "solvers"]}
STAGES = {stage: getattr(ambjax.laws, stage) for stage in KINDS}
USED = [one for space in (*STAGES.values(), *NAMESPACES.values()) for one in vars(space).values()]
USED = [*NAMESPACES.values(), *dict.fromkeys(one for one in USED if isinstance(one, type) and one in RECORDS)]


@pytest.mark.parametrize("thing", USED, ids=lambda thing: thing.__name__)
def test_the_lines_of_use_in_a_docstring_run(thing):
    if thing is ambjax.laws.position.LinearController:
        pytest.skip("its line has matrices of the reader")
    text = str(thing.__doc__)
    lines = re.findall(r"`((?:[a-z]\w*\.)*[A-Z]\w*\([^`]*)`", " ".join(text.split()))
    if inspect.ismodule(thing):
        lines = [line.strip() for line in text.splitlines() if re.match("    [A-Z]", line)]
    assert lines
    names = {name: getattr(ambjax, name) for name in ambjax.__all__} | NAMESPACES | STAGES | {"np": np}
    for line in lines:
        eval(line, names)


FUNCTIONS = [name for name in ambjax.__all__ if inspect.isfunction(getattr(ambjax, name))]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_public_function_shows_a_call_with_its_own_arguments(name):
    function = getattr(ambjax, name)
    lines = inspect.cleandoc(function.__doc__).partition("\n    ")[2].splitlines()
    calls = [one for line in lines for one in ast.walk(ast.parse(line.strip())) if isinstance(one, ast.Call)]
    (own, *_) = [call for call in calls if ast.unparse(call.func) == f"ambjax.{name}"]
    inspect.signature(function).bind_partial(*own.args, **{str(word.arg): word.value for word in own.keywords})


def test_indented_lines_of_a_docstring_are_code_on_the_page(monkeypatch):
    pytest.importorskip("sphinx")
    monkeypatch.syspath_prepend(ROOT / "docs" / "_ext")
    from docstrings import restructured

    text = ["Use `a_b`.", "", "- `c`: a long", "  line", "", "    run = f(a_b)", "", "    g(*run)", "", "End *"]
    code = ["::", "", "    run = f(a_b)", "", "    g(*run)"]
    assert restructured(text) == ["Use ``a_b``.", "", "- ``c``: a long", "  line", "", *code, "", "End \\*"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_link_to_the_code_has_a_target_and_every_path_exists(page):
    for _, target in ROLE.findall(page.read_text()):
        pkgutil.resolve_name(target)
    for path in re.findall(r"`((?:ambjax|tuning|tests|benchmarks|docs)/[\w/.]*)`", page.read_text()):
        assert (ROOT / path).exists(), path


def test_every_equation_of_the_paper_is_linked_to_its_code():
    text = (ROOT / "docs" / "model.md").read_text()
    starts = [(match.start(), match[1]) for match in re.finditer(r":label: eq-(\d+)", text)]
    assert [int(number) for _, number in starts] == list(range(1, 15)), "the numbers are those of the paper"
    ends = [start for start, _ in starts[1:]] + [len(text)]
    for (start, number), end in zip(starts, ends, strict=True):
        assert ROLE.search(text, start, end), f"Eq. ({number}) has no link to the code"


def record_of(table, kind):
    """Return the record whose fields are the keys of a table; None if there is none."""
    if table == "reference":
        return SIGNALS[kind]
    stage = table.partition(".")[2]
    return KINDS[stage][kind] if stage in KINDS else case_file.RECORDS.get(table)


@pytest.mark.parametrize(("table", "beside"), ROWS, ids=lambda x: x if isinstance(x, str) else x.get("kind", "-"))
def test_every_key_has_a_range_and_a_meaning(table, beside):
    rows = case_file.rows_of(table, record_of(table, beside.get("kind")), beside)
    named = "kind" in beside or table in ("plant", "controller.notch")
    assert [row.name for row in rows if row.name == "kind"] == ["kind"] * named
    for row in rows:
        assert row.allowed, f"{table}.{row.name}: the reader does not say what it allows"
        if table in NAMES and table not in ELSEWHERE and (table, row.name) not in OWN_SPEEDS:
            path = f"{table}.{row.name}"
            assert any(one == path or one.startswith(f"{path}.") for one in remarks()), f"{path}: not in the template"
        if row.name not in ("kind", "terms"):
            assert row.doc, f"{table}.{row.name}: give its field a doc, or its line in the template a comment"


@pytest.mark.parametrize(
    "table", ["plant", "sensor", "initial", "actuator", "clock", "tune", "tune.weights", "tune.limits"]
)
def test_defaults_are_those_of_the_reader(table):
    """A case with each number set to the default on the page equals the case without these numbers, to six digits."""
    rows = case_file.rows_of(table, case_file.RECORDS.get(table))
    given = {row.name: number for row in rows if (number := as_number(row.default)) is not None}
    assert given or table == "actuator"
    outer, _, inner = table.partition(".")
    raw = {outer: {inner: given} if inner else given}
    assert numbers_of(raw) == pytest.approx(numbers_of({outer: {}}), rel=1e-5)


def as_number(text):
    """Return a default as an int or a float; None if it is no finite number."""
    try:
        number = ast.literal_eval(text)
    except (SyntaxError, ValueError):
        return None
    return number if isinstance(number, int | float) and math.isfinite(number) else None


def numbers_of(raw):
    """Return all numbers of a case and its table [tune]."""
    raw = {table: keys | ({"risk": "cvar"} if table == "tune" else {}) for table, keys in raw.items()}  # alpha needs it
    case = case_from(raw)
    words = f"{case} {tune_from(Table(raw).table('tune'), case)}"
    return [float(x) for x in re.findall(r"-?\d+\.?\d*(?:e[+-]?\d+)?", words)]


@pytest.mark.slow
def test_metrics_and_arrays_are_those_of_the_files(tmp_path):
    case = write("[clock]\nduration = 0.01\n[rotor]\nspeed = 30000.0\n[processor]\n", str(tmp_path / "short.toml"))
    assert main(["simulate", case, "--out", str(tmp_path / "run")]) == 0
    written = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert {row[0].strip("`") for row in metrics.rows()} == {*written, "trajectory_deviation"}  # the last with --member
    with np.load(tmp_path / "run" / "trajectory.npz") as arrays:
        assert set(metrics.arrays()) == set(arrays.files)


def test_every_command_has_its_section():
    modules = (ROOT / "ambjax" / "commands").glob("*.py")
    runs = {path.stem for path in modules if "\ndef run(" in path.read_text()}
    assert set(commands.commands()) == {f"ambjax {name}" for name in runs | {"tune"}}


def test_the_readme_of_the_benchmarks_equals_the_generated_page():
    page = benchmarks.pages()["benchmarks.md"].replace(benchmarks.FROM_HERE, benchmarks.FROM_THERE)
    assert page == (ROOT / "benchmarks" / "README.md").read_text(), "run python benchmarks/report.py"


def test_the_comparison_states_the_measured_errors_and_voltages_of_the_structures():
    cases = json.loads((ROOT / "benchmarks" / "results" / "laws.json").read_text())["cases"]
    text = (ROOT / "docs" / "compare.md").read_text()
    titles = ["cascade with an integral", "cascade with super-twisting", "PID", "LQG"]
    for law, title in zip(["cascade-integral", "super-twisting", "pid", "lqg"], titles, strict=True):
        rows = [cases[name]["structures"][law] for name in ("bearing", "rig", "F20", "G20")]
        cells = [f"{1e6 * row['rms_error_median_m'][0]:.3g} µm, {row['rms_u_V'][0]:.3g} V" for row in rows]
        assert f"| {title} | {' | '.join(cells)} |\n" in text
    # the numbers below the table
    spreads = {law: row["rms_error_median_m"] for law, row in cases["G20"]["structures"].items()}
    factors = {law: f"{high / low:.0f}" for law, (_, low, high) in spreads.items()}
    assert f"a factor of {factors['pid']} for PID, and of {factors['super-twisting']} for super-twisting" in text
    assert f"lose {max(cases['F20']['structures']['lqg']['lost'])} of 500 members" in text


@pytest.mark.slow
def test_the_python_of_the_readme_prints_the_loss_that_it_states(elsewhere, capsys):
    (program,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    last, first = map(float, re.search(r"# about (\S+); (\S+) before", program).groups())
    assert main(["template", "rig"]) == 0
    pathlib.Path("rig.toml").write_text(capsys.readouterr().out)
    exec(program.replace("for _ in", 'print(f"{loss(logs):.2f}")\nfor _ in'), {})
    found = [float(line.split()[0]) for line in capsys.readouterr().out.splitlines()]
    assert found == pytest.approx([first, last], abs=0.02)  # rounding errors grow: the signs have no boundary layer


def test_no_page_mentions_a_script_of_the_network():
    for path in itertools.chain(PAGES, (ROOT / "docs").glob("_*/*.*")):
        assert "://" not in path.read_text(), path


def test_the_committed_tables_are_current():
    for name, table in site.tables().items():
        assert (site.FOLDER / name).read_text(encoding="utf-8") == table, f"{name}: run python docs/reference/site.py"


@pytest.mark.parametrize("name", [*page_outputs.PAGES, page_outputs.GALLERY])
def test_the_committed_outputs_are_those_of_the_cells(name):
    assert page_outputs.outdated(name) == [], "run: python docs/reference/page_outputs.py"
    assert not re.search(r"/(tmp|work|root|home|Users)/", (ROOT / "docs" / f"{name}.md").read_text())


@pytest.mark.slow
def test_the_tutorial_simulates_to_the_numbers_of_its_page(elsewhere, capsys):
    text = (ROOT / "docs" / "start.md").read_text()
    pathlib.Path("my.toml").write_text(text.partition("'END'\n")[2].partition("END\n")[0])
    assert main(["simulate", "my.toml", "--out", "before"]) == 0
    block = text.partition("--out before")[2].partition(page_outputs.END)[0]
    shown, now = (dict(re.findall(r"^(\w+_[mVW]) +(\S+)$", x, re.MULTILINE)) for x in (block, capsys.readouterr().out))
    assert len(shown) == 4  # processors round differently, which the converter of 12 bits makes larger: 2 %
    assert [float(now[name]) for name in shown] == pytest.approx([float(x) for x in shown.values()], rel=0.02)


def anchors(page):
    """Return the anchors of a page: its targets and its titles as GitHub and MyST write them."""
    text = page.read_text()
    titles = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), flags=re.MULTILINE)
    slugs = {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}
    return slugs | set(re.findall(r"^\(([\w-]+)\)=$", text, flags=re.MULTILINE))


LINKING = [*ROOT.glob("*.md"), *PAGES, *sorted((ROOT / "docs" / "generated").glob("*.md"))]


@pytest.mark.parametrize("page", LINKING, ids=lambda page: page.stem)
def test_every_link_to_a_file_has_its_file_and_its_section(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for name, anchor in re.findall(r"\]\(([^)#\s]*)#?([^)\s]*)\)", text):
        target = (page.parent / name) if name else page
        made = target.parent == site.FOLDER and target.stem == "api"
        assert made or "://" in name or target.exists(), name
        assert not anchor or target.suffix != ".md" or made or anchor in anchors(target), f"{name}#{anchor}"


@pytest.mark.parametrize("name", ["tuning", "limits"])
def test_a_page_of_the_tuner_is_short(name):
    assert len((ROOT / "docs" / f"{name}.md").read_text().split()) <= 900


def test_the_pictures_of_the_pages_are_small():
    assert sum(path.stat().st_size for path in page_outputs.PICTURES.iterdir()) < 1e6  # bytes
