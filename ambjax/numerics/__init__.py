"""Numerical building blocks: records of numbers, smooth functions, implicit signs, random numbers, linear algebra."""
