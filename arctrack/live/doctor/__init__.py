"""Checks of whether a machine can run a cell live, and of the latency of its offsets."""
