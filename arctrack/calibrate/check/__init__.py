"""Does a setup explain a recording, stage by stage, and what to calibrate anew."""
