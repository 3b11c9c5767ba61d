"""The style of every picture: matplotlib's default without offsets of axes, independent of any matplotlibrc file."""

import matplotlib

# Decorator of every function that draws.
own_style = matplotlib.rc_context(
    {k: v for k, v in matplotlib.rcParamsDefault.items() if k != "backend"} | {"axes.formatter.useoffset": False}
)
