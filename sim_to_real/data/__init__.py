"""What a recording says: binned frames, pixel blocks, noise, and where the seam was seen."""
