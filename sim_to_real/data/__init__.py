"""The recording: binned frames, pixel blocks, noise, and where the seam was seen."""
