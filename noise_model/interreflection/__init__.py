"""Light that a joint's faces reflect onto each other."""
