"""A cell on one machine: robot, seam, camera and bus, simulated behind one seeded scheduler."""
