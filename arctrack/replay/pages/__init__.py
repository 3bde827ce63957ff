"""Files of a replay for people: its video, its overview and its page."""
