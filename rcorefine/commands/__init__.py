"""What the command `rcorefine` does, one file per task."""
