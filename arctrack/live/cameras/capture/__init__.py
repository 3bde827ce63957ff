"""Capture from real cameras, files and drivers: a subprocess of a live run that publishes their frames."""
