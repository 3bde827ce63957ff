"""The camera's pose on the robot: inputs, stage, record and page."""
