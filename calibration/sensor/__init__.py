"""The sensor's gain, noise and response, from flat and dark frames or from a stripe that stands still."""
