"""Gain tuning by gradients of an ensemble's loss. It uses only the public names of `ambjax`.

`tune` is imported on first use, so that `ambjax tune --help` does not import JAX.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tuning.command import TunedCase, tune

__all__ = ["TunedCase", "tune"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'tuning' has no attribute '{name}'")
    from tuning import command

    return getattr(command, name)
