"""The calibration of the poses' delay: stage, record and page."""
