"""What the program needs of the machine it runs on: files that are sealed, Ctrl-C, one line of words."""
