"""The instrument: laser, filter and its spectrum, camera and sensor."""
