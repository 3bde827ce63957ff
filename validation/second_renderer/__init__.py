"""A second renderer, which shares no code with the model: predictions are held against it."""
