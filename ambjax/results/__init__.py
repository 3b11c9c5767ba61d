"""Results of a case as objects of Python: of one run, of the members of its spread, and of its linearised loop."""
