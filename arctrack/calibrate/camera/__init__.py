"""The calibration of the camera: images of a board, stage, record and page."""
