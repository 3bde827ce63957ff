"""Check of whether a setup explains a recording, by stage, and what to calibrate again."""
