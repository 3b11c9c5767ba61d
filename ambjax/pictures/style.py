"""The style of every picture: matplotlib's default, independent of any matplotlibrc file."""

import pathlib

import matplotlib
from matplotlib.figure import Figure

# Decorator of every function that draws.
own_style = matplotlib.rc_context({k: v for k, v in matplotlib.rcParamsDefault.items() if k != "backend"})


@own_style
def save(figure: Figure, path: pathlib.Path, dpi: int = 130) -> None:
    """Write a picture to a file."""
    figure.savefig(path, dpi=dpi)
