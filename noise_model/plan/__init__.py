"""The plan of a sensor: where camera and laser should stand, and where the path is blind."""
