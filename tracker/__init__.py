"""Tracker from a frame and a pose to a seam: stripe, profile, joint, follow, and the step that joins them."""
