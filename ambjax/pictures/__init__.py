"""Pictures, drawn from arrays in SI units."""
