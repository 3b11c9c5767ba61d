"""The search for the minimum of the goal: screen, descent, restarts and rounds."""
