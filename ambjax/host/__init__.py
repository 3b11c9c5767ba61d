"""Services of the operating system: files with checksums, a lock, standard streams, Ctrl-C, and text for messages."""
