"""The commands of `ambjax`, one module each: `run(args)` returns an exit code and a summary.

Exit code 0: done. 1: done, and the answer is no (rotor lost, a condition fails). Bad input raises a ValueError, which
`__main__` turns into one line on stderr and exit code 2.
"""
