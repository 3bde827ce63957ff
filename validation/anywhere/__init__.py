"""Scenes at random, in a world that shares nothing with the forward model but records."""
