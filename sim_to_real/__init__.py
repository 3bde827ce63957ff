"""Where simulation and recordings part: the forward model held against what the camera saw."""
