"""Gain tuning by gradients: to come. It will use only the public names of `ambjax`."""
