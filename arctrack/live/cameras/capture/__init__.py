"""Frames of real cameras, files and drivers: what runs in a process beside a live run, and publishes them."""
