"""Tasks of the command `rcorefine`, one file per task."""
