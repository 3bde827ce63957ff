"""Data of a live run for other processes in shared memory: its frames, tracks and state."""
