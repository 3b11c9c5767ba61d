"""The house: imports only point down, and heavy ones stay where they belong."""

import ast
import graphlib
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parent.parent

# Floor of every module. An import points to a lower floor, or within its own without a cycle. A new module gets
# a row here. `control.*` stands for all modules of that package.
FLOORS = {
    1: "_pytree _apart _kernel smooth gaussian _linear _version _words sealed interrupts",
    2: "plant signals span integrate explicit trajectory",
    3: "control control.* scenario metrics",
    4: "loop sliding extend method rollout theorem verdict proof linear paper evidence claims ledger plotting overview",
    5: "__init__ ensemble ensemble.*",
    6: "casefile doubts reach tomltable spreadfile template outputs worker pace studies mapping commands __main__ "
    "tuning tuning.*",
}
# Modules that may import matplotlib: those that draw.
DRAWING = {
    "ambjax.plotting",
    "ambjax.overview",
    "ambjax.ensemble.pictures",
    "ambjax.ensemble.tornado",
    "ambjax.ensemble.heatmaps",
    "ambjax.ensemble.scales",
    "tuning.pictures",
}
FILES = sorted([*ROOT.glob("ambjax/**/*.py"), *ROOT.glob("tuning/**/*.py")])


def module_of(path):
    """Dotted name of a file: ambjax.control.laws; a package's own file is the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): path for path in FILES}


def floor_of(module):
    """Floor of a module, or None if the table does not know it."""
    name = "__init__" if module == "ambjax" else module.removeprefix("ambjax.")
    for floor, names in FLOORS.items():
        if name in names.split() or (name.rpartition(".")[0] + ".*") in names.split():
            return floor
    return None


def targets_of(node, module):
    """Dotted names that an import statement brings in; of `from a import b`, a.b if that is a module, else a."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    base = node.module or ""
    if node.level:
        package = module if MODULES[module].name == "__init__.py" else module.rpartition(".")[0]
        up = package.split(".")[: len(package.split(".")) - node.level + 1]
        base = ".".join([*up, *([base] if base else [])])
    return [f"{base}.{alias.name}" if f"{base}.{alias.name}" in MODULES else base for alias in node.names]


def imports(module, *, top_level=False):
    """Everything that a module imports, wherever in the file; or only what its import executes."""
    tree = ast.parse(MODULES[module].read_text())
    nodes = tree.body if top_level else ast.walk(tree)
    found = [node for node in nodes if isinstance(node, (ast.Import, ast.ImportFrom))]
    return {target for node in found for target in targets_of(node, module)}


def ours(names):
    return {name for name in names if name.split(".")[0] in ("ambjax", "tuning")}


@pytest.mark.parametrize("module", MODULES)
def test_every_module_has_a_floor(module):
    assert floor_of(module) is not None, f"{module}: give it a floor in the table FLOORS of tests/test_layers.py"


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_down(module):
    for target in ours(imports(module)) - {module}:
        assert target in MODULES, f"{module} imports {target}, which is no file of ours"
        here, there = floor_of(module) or 0, floor_of(target) or 0  # one without a floor fails above
        assert there <= here, f"{module} (floor {here}) imports {target} (floor {there}): imports only point down"


def test_no_cycles():
    graph = {module: ours(imports(module)) - {module} for module in MODULES}
    # CycleError names the cycle
    list(graphlib.TopologicalSorter(graph).static_order())


@pytest.mark.parametrize("module", [m for m in MODULES if m.startswith("ambjax")])
def test_ambjax_stands_alone(module):
    # optax belongs to tuning; diffrax to benchmarks; scipy to ensembles, imported where it is used
    roots = {name.split(".")[0] for name in imports(module)}
    at_once = {name.split(".")[0] for name in imports(module, top_level=True)}
    assert not roots & {"tuning", "optax", "diffrax", "ross", "control", "equinox"}
    assert "scipy" not in (roots if not module.startswith("ambjax.ensemble") else at_once)


@pytest.mark.parametrize("module", [m for m in MODULES if m.startswith("tuning")])
def test_tuning_uses_public_names_only(module):
    for target in ours(imports(module)):
        private = target.startswith("ambjax._") and not target.endswith("__")  # ambjax.__main__ is public
        assert not private, f"{module} imports {target}"
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("ambjax"):
            private = [alias.name for alias in node.names if alias.name.startswith("_")]
            assert private in ([], ["__version__"]), f"{module} imports {private} from {node.module}"


@pytest.mark.parametrize("module", MODULES)
def test_matplotlib_only_where_things_are_drawn(module):
    used = any(name.split(".")[0] == "matplotlib" for name in imports(module))
    assert not used or module in DRAWING, f"{module} imports matplotlib: only {sorted(DRAWING)} may"


def test_import_is_light_and_leaves_the_configuration_alone():
    code = """
import sys, jax
before = dict(jax.config.values)
import ambjax
heavy = {"matplotlib", "optax", "scipy.integrate", "diffrax", "tuning", "tqdm", "platformdirs"} & set(sys.modules)
assert not heavy, heavy
changed = {k for k, v in jax.config.values.items() if before.get(k) != v}
assert not changed, changed
assert not jax.config.jax_enable_x64
from jax._src import xla_bridge
assert not xla_bridge._backends, "importing ambjax started a backend"
"""
    # with JAX's own defaults: -I drops PYTHON* variables only, so the environment is given by hand
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env={"PATH": "/usr/bin:/bin"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
