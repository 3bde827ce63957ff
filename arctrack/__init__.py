"""arctrack meets the world: recordings, replay, pictures and the command line."""
