"""The cell in real time, as a process of its own: a robot on a real bus, and frames in shared memory."""
