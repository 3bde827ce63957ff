"""Tracker's side of the bus: one controller for a live run, a replay and a simulation."""
