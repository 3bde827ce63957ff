"""Calibrations from files to a page and values for the setup; the commands and `calibrate all` run them."""
