"""Run JavaScript with node, if this machine has it."""

import shutil
import subprocess

import numpy as np
import pytest

NODE = shutil.which("node")
with_node = pytest.mark.skipif(NODE is None, reason="there is no node: install nodejs to run the exported JavaScript")

# Reads rows of float64 into `rows`, and writes what `run(row)` returns, rows of float64.
HARNESS = """
const fs = require("fs"), [width, from, to] = process.argv.slice(2);
const given = fs.readFileSync(from), flat = new Float64Array(given.buffer, given.byteOffset, given.length / 8);
const found = [];
for (let k = 0; k < flat.length; k += +width) found.push(...run(flat.subarray(k, k + +width)));
fs.writeFileSync(to, Buffer.from(Float64Array.from(found).buffer));
"""


def run_rows(text, rows, folder):
    """Return the results of the function `run` of a script for each row [points, numbers]."""
    assert NODE is not None
    (folder / "run.js").write_text('"use strict";\n' + text + HARNESS)
    np.ascontiguousarray(rows, np.float64).tofile(folder / "rows")
    command = [NODE, "run.js", str(rows.shape[1]), "rows", "found"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    return np.fromfile(folder / "found").reshape(len(rows), -1)
