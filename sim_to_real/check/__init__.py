"""Predictions held against renderers that are not ours."""
