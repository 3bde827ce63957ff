"""The open stream: JSON lines over TCP, for a robot whose program can open a socket."""
