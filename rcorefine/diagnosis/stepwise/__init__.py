"""Effects added and dropped one at a time, until nothing is missing."""
