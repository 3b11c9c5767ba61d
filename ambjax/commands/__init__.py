"""The commands behind `ambjax`, a module each: `run(args)` gives an exit code and a summary.

0: done. 1: done, and the answer is no (rotor lost, a condition fails). Bad input is a ValueError, which
`__main__` turns into one line and exit code 2.
"""
