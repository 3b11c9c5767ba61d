"""Layers of the code: modules import from lower layers only, and heavy packages only where they are needed."""

import ast
import functools
import graphlib
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parent.parent

# The layers of each package, the lowest first: each is a folder, or a module beside these folders. A module
# imports only from lower layers or from its own, without a cycle.
LAYERS = {
    "ambjax": "_version text compiler numerics host world control simulation "
    "extend laws signals plants sensors actuators solvers codegen theorem ensemble linear "
    "paper pictures cases results page commands __init__ __main__",
    "tuning": "events problem judge solve validate front rounds report machines command __init__ __main__",
}
# Folders and modules that may import matplotlib: those that draw.
DRAWING = ("ambjax.pictures.", "tuning.report.pictures")
FILES = sorted([*ROOT.glob("ambjax/**/*.py"), *ROOT.glob("tuning/**/*.py")])


def module_of(path):
    """Dotted name of a file: ambjax.control.stages; a package's own file is the package."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): path for path in FILES}


def layer_of(module):
    """Return the layer of a module, None if it is not in the table. All layers of tuning are above those of ambjax."""
    package, _, rest = module.partition(".")
    layer = rest.partition(".")[0] or "__init__"
    layers = [(one, name) for one, names in LAYERS.items() for name in names.split()]
    return layers.index((package, layer)) if (package, layer) in layers else None


def targets_of(node, module):
    """Return the modules that an import statement names: for `from a import b`, a.b if that is a module, else a."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    assert not node.level, f"{module}: write the whole name of the module in place of a relative import"
    both = [(f"{node.module}.{alias.name}", node.module) for alias in node.names]
    return [inner if inner in MODULES else outer for inner, outer in both]


@functools.cache
def imports(module, *, top_level=False):
    """Return the names of all modules that a module imports; with `top_level`, without imports inside functions."""
    tree = ast.parse(MODULES[module].read_text())
    nodes = tree.body if top_level else ast.walk(tree)
    found = [node for node in nodes if isinstance(node, (ast.Import, ast.ImportFrom))]
    return {target for node in found for target in targets_of(node, module)}


def ours(names):
    return {name for name in names if name.split(".")[0] in ("ambjax", "tuning")}


@pytest.mark.parametrize("module", MODULES)
def test_modules_import_from_lower_layers_only(module):
    here, drawn = layer_of(module), any(name.split(".")[0] == "matplotlib" for name in imports(module))
    assert here is not None, f"{module}: give it a layer in the table LAYERS of tests/test_layers.py"
    assert not drawn or module.startswith(DRAWING), f"{module} imports matplotlib: only {DRAWING} may"
    for target in ours(imports(module)) - {module}:
        assert target in MODULES, f"{module} imports {target}, which is no file of ours"
        there = layer_of(target)
        assert there <= here, f"{module} (layer {here}) imports {target} (layer {there}): imports only point down"


def test_imports_have_no_cycles():
    graph = {module: ours(imports(module)) - {module} for module in MODULES}
    # CycleError names the cycle
    list(graphlib.TopologicalSorter(graph).static_order())


def test_no_loop_overrides_a_method_with_a_body():
    nodes = (node for module in MODULES for node in ast.walk(ast.parse(MODULES[module].read_text())))
    classes = {node.name: node for node in nodes if isinstance(node, ast.ClassDef)}
    own = {name: {x.name: x for x in node.body if isinstance(x, ast.FunctionDef)} for name, node in classes.items()}

    def above(name):
        bases = [x.id for x in classes[name].bases if isinstance(x, ast.Name) and x.id in classes]
        return bases + [further for base in bases for further in above(base)]

    loops = {name: above(name) for name in classes if any("advance" in own[x] for x in [name, *above(name)])}
    assert {"Sampled", "ClosedLoop", "SampledMachine", "Twin", "Monitored"} <= set(loops)
    for name, base, method in ((n, b, m) for n, bases in loops.items() for b in bases for m in own[n]):
        abstract = method not in own[base] or "NotImplementedError" in ast.unparse(own[base][method])
        assert abstract, f"{name}.{method} overrides that of {base}: hold a {base} in place of deriving from it"


# Ensembles, linear analysis, the design of default gains, controllers in files, and the number of threads.
SCIPY = ("ambjax.ensemble", "ambjax.linear", "ambjax.control.regulator", "ambjax.results.runs")
SCIPY += ("ambjax.control.realisation", "ambjax.control.lqg", "ambjax.cases.named_files", "ambjax.host.one_thread")


@pytest.mark.parametrize("module", [m for m in MODULES if m.startswith("ambjax")])
def test_ambjax_does_not_import_tuning(module):
    # optax is for losses of users; diffrax belongs to benchmarks; scipy is imported where it is used
    roots = {name.split(".")[0] for name in imports(module)}
    at_once = {name.split(".")[0] for name in imports(module, top_level=True)}
    assert not roots & {"tuning", "optax", "diffrax", "ross", "equinox"}
    assert "control" not in (roots if module != "ambjax.linear.state_space" else at_once)
    assert "scipy" not in (roots if not module.startswith(SCIPY) else at_once)


@pytest.mark.parametrize("module", [m for m in MODULES if m.startswith("tuning")])
def test_tuning_uses_public_names_only(module):
    for target in ours(imports(module)):
        assert not target.startswith("ambjax.numerics"), f"{module} imports {target}: what it needs is in ambjax.extend"
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("ambjax"):
            private = [alias.name for alias in node.names if alias.name.startswith("_")]
            assert private in ([], ["__version__"]), f"{module} imports {private} from {node.module}"


def test_the_import_is_fast_and_does_not_change_the_configuration():
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
    command, env = [sys.executable, "-c", code], {"PATH": "/usr/bin:/bin"}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
