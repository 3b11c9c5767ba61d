"""An FMU as a file, a zip archive of model description, C sources and compiled library, and its reference data."""

import importlib.resources
import io
import math
import platform
import sys
import zipfile
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ambjax.codegen.block import Block
from ambjax.codegen.c99 import machine
from ambjax.codegen.c99.source import MARK, Origin, Writer
from ambjax.codegen.fmi.description import build_description, description, filled, token
from ambjax.codegen.loop_step import block_of
from ambjax.codegen.trace import Trace, in_jax
from ambjax.codegen.twins import series
from ambjax.compiler.short_compilation import precision
from ambjax.control.cascade import Cascade
from ambjax.numerics.records import replaced
from ambjax.simulation.clock import Clock
from ambjax.simulation.rollout import rollout
from ambjax.world.scenario import Scenario

# Largest number of samples of the reference data of each block. Those of a loop are few, because its signs amplify
# rounding errors. A plant alone is unstable: its data also end when an error has grown by the factor GROWTH.
SAMPLES = {"controller": 1000, "loop": 200, "plant": 1000}
GROWTH = 1e4
SHARED_FILES = ("fmu_core.h", "fmu_functions.h", "fmi{}.c")
# For each system: its name in the folders of binaries of FMI 2.0 and of FMI 3.0, and the ending of a library.
SYSTEMS = {
    "linux": ("linux", "linux", ".so"),
    "darwin": ("darwin", "darwin", ".dylib"),
    "win32": ("win", "windows", ".dll"),
}


def sources(traced: Trace, identifier: str, origin: Origin, version: int) -> tuple[dict[str, str], str]:
    """Return the text of each source file by name, and the GUID of the FMU.

    - `traced`: trace of the block, in double precision.
    - `identifier`: the modelIdentifier of the FMU, and the prefix of all C names.
    - `version`: of FMI, 2 or 3.
    """
    writer = Writer(traced, identifier, origin)
    home = importlib.resources.files("ambjax.codegen.fmi")
    names = [name.format(version) for name in SHARED_FILES]
    found = {f"{identifier}.h": writer.header(), f"{identifier}.c": writer.source()}
    found |= {name: (home / name).read_text(encoding="utf-8") for name in names}
    guid = token(traced, identifier, found)
    found["model.h"] = filled(
        "model.h",
        p=identifier,
        token=guid,
        inputs=len(traced.inputs),
        outputs=len(traced.outputs),
        parameters=len(traced.parameters),
        states=len(traced.state),
        reads=int(traced.block.noun != "controller"),
        least=", ".join(_bound(x.least) for x in traced.parameters),
        most=", ".join(_bound(x.most) for x in traced.parameters),
        infinite=", ".join(str(int(x.infinite)) for x in traced.parameters),
        whole=", ".join(str(int(x.whole)) for x in traced.parameters),
    )
    return found, guid


def _bound(x: float) -> str:
    """Return a bound as a constant of C: the largest finite number stands for infinity."""
    return repr(math.copysign(sys.float_info.max, x) if math.isinf(x) else float(x))


def binary_name(identifier: str, version: int) -> str:
    """Return the path of the binary for this machine inside an FMU."""
    old, new, ending = SYSTEMS.get(sys.platform, SYSTEMS["linux"])
    wide = sys.maxsize > 2**32
    architecture = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    folder = f"{old}{'64' if wide else '32'}" if version == 2 else f"{architecture}-{new}"
    return f"binaries/{folder}/{identifier}{ending}"


def compiled(files: dict[str, str], identifier: str) -> bytes:
    """Return the library that the C compiler of this machine makes of an FMU's sources."""
    with machine.scratch() as folder:
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
        library = folder / f"{identifier}.so"
        units = [folder / name for name in files if name.endswith(".c")]
        if messages := machine.build(units, library, *machine.SHARED, "-fvisibility=hidden", asked=machine.FMU):
            raise ValueError(f"--format fmu: {machine.compiler()} cannot compile the FMU ({machine.short(messages)}).")
        return library.read_bytes()


def packed(traced: Trace, identifier: str, origin: Origin, version: int) -> bytes:
    """Return the bytes of an FMU. A later export recognises it by MARK, the comment of the archive."""
    files, guid = sources(traced, identifier, origin, version)
    units = [name for name in files if name.endswith(".c")]
    members: dict[str, str | bytes] = {f"sources/{name}": text for name, text in files.items()}
    members["modelDescription.xml"] = description(traced, identifier, origin.case, guid, units, version)
    if version == 3:
        members["sources/buildDescription.xml"] = build_description(identifier, units)
    members[binary_name(identifier, version)] = compiled(files, identifier)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.comment = MARK.format(p=identifier).encode()
        for name, content in members.items():
            entry = zipfile.ZipInfo(name)  # a fixed date: the same case gives the same sources and description
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, content)
    return buffer.getvalue()


def run_block(block: Block, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Run a block in JAX. Return its outputs [samples, outputs] and status [samples], the bits as an integer."""
    memory, step = in_jax(block)

    def one(memory: Any, x: Array) -> tuple[Any, tuple[Array, Array]]:
        memory, outputs, status = step(memory, x)
        bits = sum(jnp.where(bit, 1 << k, 0) for k, bit in enumerate(jax.tree.leaves(status)))
        return memory, (jnp.stack(jax.tree.leaves(outputs)), jnp.asarray(bits))

    outputs, bits = jax.jit(lambda rows: jax.lax.scan(one, memory, rows)[1])(jnp.asarray(rows))
    return np.asarray(outputs), np.asarray(bits)


def reference(block: Block, cascade: Cascade, scenario: Scenario, clock: Clock) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs and outputs of a block's FMU in the loop of the case.

    Each is an array [instants, 1 + numbers] with the time (s) in the first column; the outputs have one instant more.
    The inputs of a row act in the communication step that begins at its time. For a plant and a loop, the first row is
    also the input of the step that reads the sensors at the start.
    """
    count = min(clock.samples, SAMPLES[block.noun])
    if block.noun == "plant":
        pole = float(scenario.plant.pole) * block.period
        count = max(min(count, int(math.log(GROWTH) / pole)), 1)
    given = series(cascade, scenario, clock, count + 1)
    if block.noun == "controller":
        short = replaced(clock, samples=count)
        read = rollout(cascade, scenario, short).trajectory.rows
        signals = {**given, "z": read.z_measured, "z_dot": read.z_dot, "i": read.i}
        rows = np.array([signals[name][:count] for name in block.inputs]).T
        found = np.concatenate([np.zeros((1, len(block.outputs))), run_block(block, rows)[0]])
    else:
        loop = block if block.noun == "loop" else block_of("loop", cascade, scenario, clock)
        plain = np.array([given[name] for name in loop.inputs]).T
        outputs = dict(zip(loop.outputs, run_block(loop, plain)[0].T, strict=True))
        late = [outputs[name][:count] if name == "u" else given[name][1:] for name in block.inputs]
        rows = np.array(late).T
        found = run_block(block, np.concatenate([rows[:1], rows]))[0]
    t = np.arange(count + 1) * block.period
    return np.column_stack([t[:-1], rows]), np.column_stack([t, found])


def files_of(
    block: Block, name: str, read: frozenset[str], cascade: Cascade, scenario: Scenario, clock: Clock
) -> dict[str, str]:
    """Return the texts of NAME_in.csv, NAME_ref.csv and NAME_ref.opt by file name.

    `read`: names of the inputs that the FMU has. Raises ValueError for a case that cannot be exported.
    """
    with precision("double"):
        inputs, outputs = reference(block, cascade, scenario, clock)
    named = {x: inputs[:, 1 + k] for k, x in enumerate(block.inputs) if x in read}
    options = {"StartTime": 0.0, "StopTime": float(outputs[-1, 0]), "StepSize": block.period, "RelTol": 1e-9}
    return {
        f"{name}_in.csv": _csv(["time", *named], np.column_stack([inputs[:, 0], *named.values()])),
        f"{name}_ref.csv": _csv(["time", *block.outputs], outputs),
        f"{name}_ref.opt": "".join(f"{key},{value!r}\n" for key, value in options.items()),
    }


def _csv(names: list[str], rows: np.ndarray) -> str:
    head = ",".join(f'"{name}"' for name in names)
    return "\n".join([head, *(",".join(map(repr, map(float, row))) for row in rows), ""])
