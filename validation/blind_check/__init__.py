"""The blind check of the diagnosis: recordings made, diagnosed and opened, and their files."""
