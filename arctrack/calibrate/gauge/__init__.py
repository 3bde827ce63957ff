"""The calibration by a gauge: its images, stage, record and page."""
