"""The fit of a stripe in every scan line: sixteen lines at once, a lane a line."""
