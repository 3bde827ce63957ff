"""Live run: cameras, bus and tracker in one loop, and its subprocesses."""
