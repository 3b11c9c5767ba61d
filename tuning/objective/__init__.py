"""What is minimised: loss, risk, conditions and ranges of gains, over many members at once."""
