"""Gap between simulation and recordings: the forward model compared with what the camera saw."""
