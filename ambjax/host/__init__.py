"""What the program needs of the machine it runs on: sealed files, a lock, streams, Ctrl-C, one line of words."""
