"""camera.html: a camera's calibration on one self-contained page."""
