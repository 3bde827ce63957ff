"""Recordings that are simulated, and a simulated cell around the real controller."""
