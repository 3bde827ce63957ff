"""The page of a live run, served by a process of its own that reads the run's journal alone."""
