"""Text for people: messages, hints for misspelt names, and HTML pages."""
