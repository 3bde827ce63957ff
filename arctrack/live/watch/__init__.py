"""What runs beside a live loop: whether the map explains what is seen, and what the arc's light says."""
