"""Records of numbers, smooth functions, random numbers, and what makes XLA compile them well."""
