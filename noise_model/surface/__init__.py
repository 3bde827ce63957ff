"""A joint's surface: its shape, faces, reflectance, and what it hides."""
