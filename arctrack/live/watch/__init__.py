"""Watch of a live run: whether the map explains the frames, and the arc's state by its light."""
