"""What judges arctrack and is no part of it: run from a clone, never installed."""
