"""The seam along the path: located, followed, steered by."""
