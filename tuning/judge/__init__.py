"""Evaluation of an answer on members that the search does not use."""
