"""Layers of the code: modules import from lower layers only, and heavy packages only where they are needed."""

import ast
import collections
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
    "ambjax": "_version text compiler numerics host world control simulation extend codegen theorem ensemble linear "
    "paper pictures cases results page commands __init__ __main__",
    "tuning": "events optimisers problem judge solve validate front rounds report command __init__ __main__",
}
# Folders and modules that may import matplotlib: those that draw.
DRAWING = ("ambjax.pictures.", "tuning.report.pictures")
FILES = sorted([*ROOT.glob("ambjax/**/*.py"), *ROOT.glob("tuning/**/*.py")])


def module_of(path):
    """Dotted name of a file: ambjax.control.laws; a package's own file is the package."""
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
    base = node.module or ""
    if node.level:
        package = module if MODULES[module].name == "__init__.py" else module.rpartition(".")[0]
        up = package.split(".")[: len(package.split(".")) - node.level + 1]
        base = ".".join([*up, *([base] if base else [])])
    return [f"{base}.{alias.name}" if f"{base}.{alias.name}" in MODULES else base for alias in node.names]


@functools.cache
def tree_of(module):
    """Syntax tree of a module."""
    return ast.parse(MODULES[module].read_text())


@functools.cache
def imports(module, *, top_level=False):
    """Return the names of all modules that a module imports; with `top_level`, without imports inside functions."""
    tree = tree_of(module)
    nodes = tree.body if top_level else ast.walk(tree)
    found = [node for node in nodes if isinstance(node, (ast.Import, ast.ImportFrom))]
    return {target for node in found for target in targets_of(node, module)}


def ours(names):
    return {name for name in names if name.split(".")[0] in ("ambjax", "tuning")}


@pytest.mark.parametrize("module", MODULES)
def test_every_module_has_a_layer(module):
    assert layer_of(module) is not None, f"{module}: give it a layer in the table LAYERS of tests/test_layers.py"


@pytest.mark.parametrize("module", MODULES)
def test_modules_import_from_lower_layers_only(module):
    for target in ours(imports(module)) - {module}:
        assert target in MODULES, f"{module} imports {target}, which is no file of ours"
        here, there = layer_of(module), layer_of(target)
        assert there <= here, f"{module} (layer {here}) imports {target} (layer {there}): imports only point down"


def test_imports_have_no_cycles():
    graph = {module: ours(imports(module)) - {module} for module in MODULES}
    # CycleError names the cycle
    list(graphlib.TopologicalSorter(graph).static_order())


# Ensembles, linear analysis, the design of default gains, and controllers in files.
SCIPY = ("ambjax.ensemble", "ambjax.linear", "ambjax.control.regulator", "ambjax.results.runs")
SCIPY += ("ambjax.control.realisation", "ambjax.cases.controller_file")


@pytest.mark.parametrize("module", [m for m in MODULES if m.startswith("ambjax")])
def test_ambjax_does_not_import_tuning(module):
    # optax belongs to tuning; diffrax to benchmarks; scipy is imported where it is used
    roots = {name.split(".")[0] for name in imports(module)}
    at_once = {name.split(".")[0] for name in imports(module, top_level=True)}
    assert not roots & {"tuning", "optax", "diffrax", "ross", "equinox"}
    assert "control" not in (roots if module != "ambjax.linear.state_space" else at_once)
    assert "scipy" not in (roots if not module.startswith(SCIPY) else at_once)


@pytest.mark.parametrize("module", [m for m in MODULES if m.startswith("tuning")])
def test_tuning_uses_public_names_only(module):
    for target in ours(imports(module)):
        assert not target.startswith("ambjax.numerics"), f"{module} imports {target}: what it needs is in ambjax.extend"
    for node in ast.walk(tree_of(module)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("ambjax"):
            private = [alias.name for alias in node.names if alias.name.startswith("_")]
            assert private in ([], ["__version__"]), f"{module} imports {private} from {node.module}"


STAGES = {"Observer", "PositionLaw", "InversionLaw", "CurrentLaw"}


def modules_of_laws():
    """Return the modules that define a law: a class that derives, also through other classes, from a stage."""
    laws, before = STAGES, set()
    classes = [(m, node) for m in MODULES for node in tree_of(m).body if isinstance(node, ast.ClassDef)]
    bases = [(m, node.name, {ast.unparse(b).partition("[")[0] for b in node.bases}) for m, node in classes]
    while laws != before:
        before, laws = laws, laws | {name for _, name, kinds in bases if kinds & laws}
    return {m for m, name, kinds in bases if kinds & laws}


LAWS = modules_of_laws()
# Modules that may import the modules of laws: the reader of [controller], the paper's parameters, the public API.
MAKERS = ("ambjax.control.", "ambjax.cases.controller_tables", "ambjax.paper.", "ambjax", "ambjax.extend")


@functools.cache
def own_gains():
    """Return the names of the gains of laws, without names that other modules define too."""
    classes = {m: [node for node in tree_of(m).body if isinstance(node, ast.ClassDef)] for m in MODULES}

    def numbers(kind):
        rows = (n for n in kind.body if isinstance(n, ast.AnnAssign) and "ClassVar" not in ast.unparse(n))
        return {n.target.id for n in rows}

    fields = {m: set().union(*map(numbers, classes[m])) for m in MODULES}
    defined = {m: {n.name for c in classes[m] for n in c.body if isinstance(n, ast.FunctionDef)} for m in MODULES}
    others = set().union(*(fields[m] | defined[m] for m in MODULES if m not in LAWS and not m.startswith(MAKERS[2])))
    return set().union(*(fields[m] for m in LAWS)) - others - {"requirement"}


@pytest.mark.parametrize("module", [m for m in MODULES if not (m in MAKERS or m.startswith(MAKERS[:3]))])
def test_modules_outside_control_use_no_law_and_no_gain_by_name(module):
    # a module that does not import a law's class cannot test for it, but it could still read a gain by its name
    assert not imports(module) & LAWS, f"{module} knows a law: call a method of the law (ambjax/control/base.py)"
    used = set()
    for node in ast.walk(tree_of(module)):
        if isinstance(node, ast.Attribute):
            used.add(node.attr)
        elif isinstance(node, ast.Constant) and len(str(node.value)) > 1:  # a letter may be a unit's prefix
            used.add(node.value)
    assert not used & own_gains(), f"{module} uses a gain of a law: call a method of the law (ambjax/control/base.py)"


def test_the_test_finds_the_gains_of_the_laws():
    assert {"gamma", "c", "k", "k_1", "k_2", "k_p", "k_int", "k_aw", "l"} <= own_gains()


@pytest.mark.parametrize("module", MODULES)
def test_only_modules_that_draw_import_matplotlib(module):
    used = any(name.split(".")[0] == "matplotlib" for name in imports(module))
    assert not used or module.startswith(DRAWING), f"{module} imports matplotlib: only {DRAWING} may"


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
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env={"PATH": "/usr/bin:/bin"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_no_class_name_is_defined_twice():
    """An exception is a name of several stages, such as `position.SlidingMode` and `current.SlidingMode`."""
    homes = collections.defaultdict(list)
    for module in MODULES:
        for node in tree_of(module).body:
            if isinstance(node, ast.ClassDef):
                homes[node.name].append(module)
    twice = {name: found for name, found in homes.items() if len(found) > 1}
    assert twice == {"SlidingMode": ["ambjax.control.current", "ambjax.control.position"]}


def test_no_module_name_is_used_twice():
    names = collections.Counter(path.stem for path in MODULES.values() if not path.stem.startswith("__"))
    assert [name for name, count in names.items() if count > 1] == []


# Largest share of the annotations of parameters and results that are Any, contain it, or are missing.
ANY_SHARE = 0.05
# Largest number of local variables with such an annotation: lower it when one goes.
ANY_LOCALS = 120


@functools.cache
def meanings(module):
    """Return the dotted name for each name of a module: imported names, and variables of its top level."""
    nodes = [node for node in ast.walk(tree_of(module)) if isinstance(node, ast.ImportFrom)]
    imported = {alias.asname or alias.name: f"{node.module}.{alias.name}" for node in nodes for alias in node.names}
    return imported | {name: f"{module}.{name}" for name, _ in variables(module)}


def variables(module):
    """Return name and value of each variable of a module's top level."""
    for node in tree_of(module).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        yield from ((target.id, node.value) for target in targets if isinstance(target, ast.Name) and node.value)


def contains(annotation, module, loose):
    """Return whether an annotation is missing, or contains a name of one of `loose`."""
    names = meanings(module)
    used = (node.id for node in ast.walk(annotation or ast.Name("Any")) if isinstance(node, ast.Name))
    return annotation is None or any(names.get(name) in loose for name in used)


@functools.cache
def any_likes():
    """Dotted names of Any and of its aliases."""
    types = (ast.Name, ast.Subscript, ast.BinOp)
    aliases = [(f"{m}.{name}", value, m) for m in MODULES for name, value in variables(m) if isinstance(value, types)]
    loose, before = {"typing.Any"}, set()
    while loose != before:
        before, loose = loose, loose | {name for name, value, m in aliases if contains(value, m, loose)}
    return loose


def annotations_of(module):
    """The annotations of the parameters and results of all functions of a module; None where one is missing."""
    tree = tree_of(module)
    methods = {id(node) for kind in ast.walk(tree) if isinstance(kind, ast.ClassDef) for node in kind.body}
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            given = node.args
            static = any(isinstance(x, ast.Name) and x.id == "staticmethod" for x in node.decorator_list)
            named = [*given.posonlyargs, *given.args][id(node) in methods and not static :]
            yield from (x.annotation for x in [*named, *given.kwonlyargs, given.vararg, given.kwarg] if x)
            yield node.returns


def test_few_annotations_are_any():
    # pyright does not check expressions of type Any
    loose = [contains(x, module, any_likes()) for module in MODULES for x in annotations_of(module)]
    assert len(loose) > 3000
    assert sum(loose) / len(loose) < ANY_SHARE, "give the new parameters and results types: a TypeVar, a record, object"


def locals_of(module):
    """The annotations of the local variables of all functions of a module."""
    functions = [node for node in ast.walk(tree_of(module)) if isinstance(node, ast.FunctionDef)]
    nodes = {id(node): node for function in functions for node in ast.walk(function)}
    return [node.annotation for node in nodes.values() if isinstance(node, ast.AnnAssign)]


def test_few_local_variables_are_any():
    assert sum(contains(x, module, any_likes()) for module in MODULES for x in locals_of(module)) <= ANY_LOCALS


def test_aliases_of_any_are_any(monkeypatch):
    module = "ambjax.numerics.records"
    tree = ast.parse("from typing import Any\nLoose = dict[str, Any]\ndef f(a: Loose, b: int, c) -> list[Any]: ...")
    meanings.cache_clear()
    any_likes.cache_clear()
    monkeypatch.setitem(globals(), "tree_of", lambda _: tree)
    monkeypatch.setitem(globals(), "MODULES", {module: None})
    try:
        assert [contains(x, module, any_likes()) for x in annotations_of(module)] == [True, False, True, True]
    finally:
        meanings.cache_clear()
        any_likes.cache_clear()
