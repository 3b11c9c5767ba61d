"""Pages written from the records, parsers and results themselves, so that they cannot drift from the code."""
