"""The commands of `ambjax`, one module each. `run(args)` returns an exit code and a summary for --json.

Exit code 0: done. 1: done, and the answer is no (rotor lost, a condition fails). Wrong input raises a ValueError, which
`__main__` prints on one line and turns into exit code 2.
"""
