"""The pages of calibrations: what was found, how well, and pictures of what it rests on."""
