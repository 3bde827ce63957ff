"""Raw measurements that calibrations read: boards, gauges, poses, flat frames, goniometer, filter curves."""
