"""Recordings compared with the model, and the pages that say what differs."""
