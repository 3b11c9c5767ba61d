"""The report of a search: verdict, tables, pictures, and the tuned case file."""
