"""Results of a case as objects of Python (run, members, linearised loop, map, export), and their files."""
