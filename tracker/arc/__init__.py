"""The arc as a frame shows it: its level, and what the optics make of its light."""
