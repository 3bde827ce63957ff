"""The calibration of the sensor: its frames, stage, record and pages."""
