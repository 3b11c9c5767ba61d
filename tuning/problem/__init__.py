"""What is minimised: the case, the gains, the loss, its limits, and their compiled evaluation."""
