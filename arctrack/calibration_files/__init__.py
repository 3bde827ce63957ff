"""Files that calibrations read and write: goniometer readings, filter curves, reflectances."""
