"""What a live run hands to other processes through memory that they share: its frames, tracks and state."""
