"""KUKA's Robot Sensor Interface: XML over UDP, an answer in each cycle."""
