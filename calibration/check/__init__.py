"""Does a setup explain what was recorded with it: measures, and which part of it would have to be off."""
