"""What an answer is worth, in words, numbers and pictures."""
