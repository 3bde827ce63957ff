"""What goes over the bus: messages, their layout, their protection, the load that they make."""
