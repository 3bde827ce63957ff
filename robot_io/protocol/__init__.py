"""Bus protocol: messages, their layout, their protection, the load that they make."""
