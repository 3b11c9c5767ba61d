"""How it is minimised: screen, descent, rounds."""
