"""The robot's poses: put together, placed in time, and held against what a robot can do."""
