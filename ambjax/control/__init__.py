"""The controller: laws by stage, and the cascade that composes them."""
