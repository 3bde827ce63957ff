"""Faults drawn from a seed, run in the simulated cell and judged."""
