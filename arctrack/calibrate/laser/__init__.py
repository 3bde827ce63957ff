"""The calibration of the laser: pairs of images, stage, record and page."""
