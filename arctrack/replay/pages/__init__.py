"""What a replay leaves for people: its video, its overview and its page."""
