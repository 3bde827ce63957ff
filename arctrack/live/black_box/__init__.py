"""The last half minute of a live run, saved as a recording that replays to the same tracks."""
