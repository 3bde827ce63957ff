"""The arc's light on a joint: the integral over its visible part, and the map of a whole image."""
