"""Services of the operating system: sealed files, a lock, standard streams, Ctrl-C and extensions."""
