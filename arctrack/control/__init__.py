"""What speaks for the tracker on the bus: one controller for a live run, a replay and a simulation."""
