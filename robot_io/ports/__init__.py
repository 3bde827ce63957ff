"""Ports of robots that have no CAN: each translates its vendor's packets to and from the bus' messages."""
