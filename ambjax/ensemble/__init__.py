"""Ensembles: many members of one closed loop at once."""
