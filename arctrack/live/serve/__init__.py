"""The live loop: frames of a camera and poses off a real bus in, offsets onto the bus."""
