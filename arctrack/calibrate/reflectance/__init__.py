"""The reflectance of a metal: goniometer readings, record and picture."""
