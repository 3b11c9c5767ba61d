"""The controller as C: the step that the simulator runs, traced, written as C99 and held against the trace."""
