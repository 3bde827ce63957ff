"""The laser sheet from its stripe on a gauge of known size: found from many poses, checked from a few."""
