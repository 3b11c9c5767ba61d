"""Case files: reading, checks, and templates."""
