"""What is drawn, from arrays in SI units."""
