"""Gain tuning by gradients through an ensemble. It uses only the public names of `ambjax`."""
