"""What goes wrong in a cell, and what happens in welding."""
