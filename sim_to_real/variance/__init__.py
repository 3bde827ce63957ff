"""Effects that show in the scatter of pixels, not in their mean."""
