"""The physics of reflected arc light and what can be inferred with it.

The room of Yu, Kim and Na, "Influence of Reflected Arc Light on Vision Sensors for Automatic GTAW
Systems": reflectance, arc, optics and sensor, a joint's surface and what it hides, the arc map of a pose
and the forward model of a frame. It imports nothing else of arctrack.
"""
