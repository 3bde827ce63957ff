"""A weld's bead, measured in the profiles behind the torch."""
