"""Case files: read, checked, doubted, and written as templates."""
