"""The search for effects: scores of all, fits of the best, alone and together."""
