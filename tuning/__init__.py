"""Gain tuning by gradients of an ensemble's loss. It uses only the public names of `ambjax`."""
