"""The style of every picture: matplotlib's default without offsets of axes, independent of any matplotlibrc file."""

from typing import Any

import matplotlib

_STYLE: Any = {k: v for k, v in matplotlib.rcParamsDefault.items() if k != "backend"}
# Decorator of every function that draws.
own_style = matplotlib.rc_context(_STYLE | {"axes.formatter.useoffset": False})
