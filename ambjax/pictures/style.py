"""The style of every picture: matplotlib's own, whatever a matplotlibrc of the user's or of the folder says."""

import matplotlib

# Around a function that draws.
own_style = matplotlib.rc_context({k: v for k, v in matplotlib.rcParamsDefault.items() if k != "backend"})
