"""The recording.toml of a laser profiler over a V-groove."""


def profiler_setup(
    columns: int,
    pitch_mm: float,
    range_mm: float = 40.0,
    ahead_mm: float = 40.0,
    depth_mm: float = 3.0,
    root_gap_mm: float = 0.0,
) -> str:
    """Return a setup of so many columns, which stands ahead of the torch."""
    return f"""\
format = "joint-tracking-recording/1"
units = "mm, s, deg, e-, DN"
[camera]
kind = "profile"
columns = {columns}
pitch_mm = {pitch_mm}
range_mm = {range_mm}
stand_off_mm = 150.0
exposure_s = 0.001
[camera.pose_in_tool]
translation_mm = [{ahead_mm}, 0.0, 0.0]
quaternion_xyzw = [0.0, 0.0, 0.0, 1.0]
[joint]
type = "v_groove"
included_angle_deg = 60.0
depth_mm = {depth_mm}
root_gap_mm = {root_gap_mm}
seam_in_base_mm = [[0.0, 0.0, 0.0], [200.0, 0.0, 0.0]]
surface_normal_in_base = [0.0, 0.0, 1.0]
"""
