"""The calibration of the arc: stage, record and page."""
