"""The way onto the bus and off it: sending, receiving, outliving the bus, logging."""
