"""Calibrations, one file each: arrays in, result objects out."""
