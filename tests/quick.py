"""Options of XLA that halve the time of a compilation. Runs take longer, and results differ in roundings only."""

import importlib.metadata

# XLA aborts on a flag that it does not know, so each version of jaxlib has its own.
FLAGS = {
    "0.10": "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false "
    "--xla_cpu_opt_preset=CPU_OPT_PRESET_FAST_COMPILE"
}


def flags() -> str:
    """Return the value of XLA_FLAGS for the installed version; empty for a version without an entry."""
    return FLAGS.get(".".join(importlib.metadata.version("jaxlib").split(".")[:2]), "")
