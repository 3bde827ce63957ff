"""Lenses as mrcal, Kalibr, ROS, OpenCV and HALCON keep them: read into a setup, and written of one."""
