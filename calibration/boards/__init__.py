"""Calibration boards: what they look like, and where their corners are in an image."""
