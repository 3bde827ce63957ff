"""What may go wrong in a cell, schedules of it, and what became of them."""
