"""The style of every picture: matplotlib's default without offsets of axes, independent of any matplotlibrc file."""

import pathlib
from typing import Any

import matplotlib
from matplotlib.figure import Figure

_STYLE: Any = {k: v for k, v in matplotlib.rcParamsDefault.items() if k != "backend"}
# Decorator of every function that draws.
own_style = matplotlib.rc_context(_STYLE | {"axes.formatter.useoffset": False})


@own_style
def save(figure: Figure, path: pathlib.Path, dpi: int = 130) -> None:
    """Write a picture to a file."""
    figure.savefig(path, dpi=dpi)
