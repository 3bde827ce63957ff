"""The plan of a sensor: its pictures and tables."""
