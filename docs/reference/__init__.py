"""Reference pages generated from the records, parsers and results of the code."""
