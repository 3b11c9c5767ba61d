"""An FMU as a file: a zip archive of the model description, the C sources and the compiled library."""

import importlib.resources
import io
import math
import platform
import sys
import zipfile

from ambjax.codegen.c99 import machine
from ambjax.codegen.c99.source import Origin, Writer
from ambjax.codegen.c99.texts import MARK
from ambjax.codegen.fmi.description import build_description, description, token
from ambjax.codegen.trace import Trace

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
    model = (home / "model.h").read_text(encoding="utf-8")
    found["model.h"] = model.format(
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
    machine.compiler("--format fmu", "Install one, set CC, or use --format c")
    with machine.scratch() as folder:
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
        library = folder / f"{identifier}.so"
        units = [folder / name for name in files if name.endswith(".c")]
        if messages := machine.build(units, library, *machine.SHARED, "-fvisibility=hidden"):
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
