"""Faster tests and pages: options of XLA that halve the time of a compilation, and a core for each process.

Runs take longer with these options, and results differ in roundings only.
"""

import importlib.metadata
import os

# XLA aborts on a flag that it does not know, so each version of jaxlib has its own.
FLAGS = {
    "0.10": "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false "
    "--xla_cpu_parallel_codegen_split_count=1 --xla_disable_hlo_passes=while-loop-invariant-code-motion"
}


def flags() -> str:
    """Return the value of XLA_FLAGS for the installed version; empty for a version without an entry."""
    return FLAGS.get(".".join(importlib.metadata.version("jaxlib").split(".")[:2]), "")


def take_core(place: int) -> None:
    """Restrict this thread, and the processes that it starts, to one core: threads that share cores take longer."""
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[place % len(cores)]})
