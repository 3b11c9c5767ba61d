"""The objective of a search: loss, risk, conditions, limits, and ranges of the gains."""
