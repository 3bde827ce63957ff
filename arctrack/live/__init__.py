"""A live run: cameras, bus and tracker turn by turn, and the processes beside it."""
