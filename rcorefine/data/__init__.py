"""The measured record: checked, read from files, matched with a model, as a frequency response."""
