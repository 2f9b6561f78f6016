"""What to measure next, to tell apart what the present record cannot."""
