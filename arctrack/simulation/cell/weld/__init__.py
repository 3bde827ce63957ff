"""A weld in a cell with a rendered camera, and what came of it."""
