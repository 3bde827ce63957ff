"""The laser sheet from its stripe on calibration boards: a plane, and how well it is known."""
